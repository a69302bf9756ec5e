"""The networks: the paper's trunk, and the heads that stand on it. The only definition there is.

What is exported is these very modules, so a trained network and its ONNX file cannot drift apart.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

TRUNK = (400, 300, 200, 100)
"""Widths of the paper's regression and grid networks."""
KEYPAD_TRUNK = (100, 50)
"""Widths of the paper's keypad network."""


class Normalise(nn.Module):
    """A residual as its direction (unit length) and its log-norm.

    The direction says where a finger is, the norm how hard it presses: separated, the first does not
    depend on the second.
    """

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the direction (n, inputs) and the natural logarithm of the norm (n, 1)."""
        norm = features.square().sum(dim=1, keepdim=True).clamp_min(1e-12).sqrt()
        return features / norm, norm.log()


def trunk(inputs: int, widths: tuple[int, ...], dropout: float) -> nn.Sequential:
    """Return the paper's stages: batch normalisation, linear, ReLU, dropout while training."""
    stages: list[nn.Module] = []
    for width in widths:
        stages += [nn.BatchNorm1d(inputs), nn.Linear(inputs, width), nn.ReLU()]
        if dropout:
            stages.append(nn.Dropout(dropout))
        inputs = width
    return nn.Sequential(*stages)


class Regression(nn.Module):
    """Position, its standard error, and whether it is a finger at all.

    Parameters
    ----------
    inputs : int
        Length of the feature vector.
    size_mm : tuple of two floats
        Width and height of the plate; no position lies outside.
    """

    size_mm: Tensor

    def __init__(
        self,
        inputs: int,
        size_mm: tuple[float, float],
        widths: tuple[int, ...] = TRUNK,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.normalise = Normalise()
        self.trunk = trunk(inputs, widths, dropout)
        # The log-norm joins the last stage: weak touches are placed less well and look more like noise.
        self.last = nn.BatchNorm1d(widths[-1] + 1)
        self.head = nn.Linear(widths[-1] + 1, 4)
        self.register_buffer("size_mm", torch.tensor(size_mm))

    def raw(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return position in plate sizes from the centre (n, 2), log of sigma in mm (n, 1), and logit (n, 1)."""
        direction, log_norm = self.normalise(features)
        out = self.head(self.last(torch.cat([self.trunk(direction), log_norm], dim=1)))
        return out[:, 0:2], out[:, 2:3], out[:, 3:4]

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return position in mm (n, 2), sigma in mm (n, 1), and confidence (n, 1)."""
        position, log_sigma, logit = self.raw(features)
        place_mm = (position.clamp(-0.5, 0.5) + 0.5) * self.size_mm
        return place_mm, log_sigma.clamp(-5.0, 5.0).exp(), logit.sigmoid()


class Classifier(nn.Module):
    """Probabilities of zones or keys: the paper's grid and keypad heads.

    Parameters
    ----------
    classes : int
        N^2 zones, row by row, or the keys and the zone beside them.
    """

    def __init__(self, inputs: int, classes: int, widths: tuple[int, ...] = TRUNK, dropout: float = 0.0) -> None:
        super().__init__()
        self.normalise = Normalise()
        self.trunk = trunk(inputs, widths, dropout)
        self.last = nn.BatchNorm1d(widths[-1])
        self.head = nn.Linear(widths[-1], classes)

    def raw(self, features: Tensor) -> Tensor:
        """Return logits of shape (n, classes)."""
        direction, _ = self.normalise(features)
        logits: Tensor = self.head(self.last(self.trunk(direction)))
        return logits

    def forward(self, features: Tensor) -> Tensor:
        """Return probabilities of shape (n, classes)."""
        return self.raw(features).softmax(dim=1)
