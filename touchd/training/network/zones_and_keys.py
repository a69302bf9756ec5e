"""Networks that estimate a zone of a grid or a key of a layout."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from touchd.training.network.network import Normalise, PaperNetwork, PositionNetwork, trunk
from touchd.training.network.recipe import TRUNK


class Classifier(nn.Module):
    """Estimates probabilities of zones or keys: the paper's grid and keypad heads.

    Parameters
    ----------
    classes : int
        N^2 zones, row by row, or the keys and the zone beside them.
    normalised : bool
        Whether to normalise features to their direction; the paper uses them as measured.
    drift : tensor of shape (k, inputs), optional
        See `Normalise`.
    """

    outputs: tuple[str, ...] = ("probability",)

    def __init__(
        self,
        inputs: int,
        classes: int,
        widths: tuple[int, ...] = TRUNK,
        dropout: float = 0.0,
        normalised: bool = True,
        drift: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.normalise = Normalise(drift) if normalised else None
        self.trunk = trunk(inputs, widths, dropout)
        self.last: nn.Module = nn.BatchNorm1d(widths[-1])
        self.head = nn.Linear(widths[-1], classes)

    def heads(self) -> tuple[nn.Linear, ...]:
        """Return the layer that `last` feeds."""
        return (self.head,)

    def raw(self, features: Tensor) -> Tensor:
        """Return logits of shape (n, classes)."""
        if self.normalise is not None:
            features, _ = self.normalise(features)
        logits: Tensor = self.head(self.last(self.trunk(features)))
        return logits

    def forward(self, features: Tensor) -> Tensor:
        """Return probabilities of shape (n, classes)."""
        return self.raw(features).softmax(dim=1)


BESIDE_MM = 10.0
"""Margin around the outermost keys in which the network resolves positions, so that no touch outside is clamped to a
key."""


class KeypadNetwork(PositionNetwork):
    """Estimates probabilities of keys from a position and its standard error.

    A key's probability is that of a Gaussian about the position to lie on the key. So any layout fits a network trained
    on the whole plate, and a touch near a key's border gets a low probability. The probabilities, including that of no
    key, add up to the finger confidence.

    Parameters
    ----------
    keys_mm : tensor of shape (keys, 4)
        Left, upper, right and lower edges.
    """

    outputs: tuple[str, ...] = ("probability",)
    low_mm: Tensor
    high_mm: Tensor

    def __init__(
        self,
        inputs: int,
        size_mm: tuple[float, float],
        keys_mm: Tensor,
        widths: tuple[int, ...] = TRUNK,
        bins: int = 32,
        drift: Tensor | None = None,
    ) -> None:
        area_mm = torch.stack([keys_mm[:, :2].amin(dim=0) - BESIDE_MM, keys_mm[:, 2:].amax(dim=0) + BESIDE_MM])
        # One probability cannot separate noise, so typical noise is part of sigma.
        super().__init__(inputs, size_mm, widths, bins, drift, area_mm, noise_apart=False)
        self.register_buffer("low_mm", keys_mm[:, :2])
        self.register_buffer("high_mm", keys_mm[:, 2:])

    def forward(self, features: Tensor) -> Tensor:  # type: ignore[override]  # returns keys, not a position
        """Return probabilities of shape (n, keys + 1); the last one is beside all keys."""
        position_mm, sigma_mm, confidence = super().forward(features)
        reach = math.sqrt(2) * sigma_mm[:, :, None]
        on = (
            torch.erf((self.high_mm - position_mm[:, None]) / reach)
            - torch.erf((self.low_mm - position_mm[:, None]) / reach)
        ) / 2
        key = on[:, :, 0] * on[:, :, 1]
        beside = (1 - key.sum(dim=1, keepdim=True)).clamp_min(0)
        return torch.cat([key, beside], dim=1) * confidence


Network = PositionNetwork | PaperNetwork | Classifier
