"""Networks that estimate a zone of a grid or a key of a layout."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from touchd.evaluation.model_scores import classes
from touchd.keypad import Layout
from touchd.localization.model import Description
from touchd.training.network.network import DROPOUT, Batch, Network, Normalise, PaperNetwork, PositionNetwork
from touchd.training.network.recipe import TRUNK, Recipe

BESIDE_MM = 10.0
"""Margin around the outermost keys in which the network resolves positions, so that no touch outside is clamped to a
key."""


class Classifier(Network):
    """Estimates probabilities of zones or keys: the paper's grid and keypad heads.

    Classes are the zones of the description's grid, row by row, or the keys of its layout and the zone beside them. The
    position estimate is the centre of the most probable zone or key; beside the keys, the plate's centre. Without
    `drift`, see `Normalise`, features count as measured, as in the paper.
    """

    outputs = ("probability",)
    centres_mm: Tensor

    def __init__(
        self,
        description: Description,
        widths: tuple[int, ...] = TRUNK,
        dropout: float = 0.0,
        drift: Tensor | None = None,
    ) -> None:
        d = description
        super().__init__(d.inputs, widths, dropout)
        self._description = d
        size_mm = np.array(d.plate.size_mm)
        if d.layout is None:
            rows, columns = np.divmod(np.arange(d.grid**2), d.grid)
            centres_mm = (np.stack([columns, rows], axis=1) + 0.5) * size_mm / d.grid
        else:
            centres_mm = np.array([*(key.centre_mm for key in d.layout.key), size_mm / 2])
        self.register_buffer("centres_mm", torch.from_numpy(centres_mm).float())
        self.normalise = None if drift is None else Normalise(drift)
        self.head = nn.Linear(widths[-1], len(centres_mm))

    def raw(self, features: Tensor) -> Tensor:
        """Return logits of shape (n, classes)."""
        if self.normalise is not None:
            features, _ = self.normalise(features)
        logits: Tensor = self.head(self.last(self.trunk(features)))
        return logits

    def forward(self, features: Tensor) -> Tensor:
        """Return probabilities of shape (n, classes)."""
        return self.raw(features).softmax(dim=1)

    def estimate_mm(self, features: Tensor) -> Tensor:
        """Return positions (n, 2), mm."""
        return self.centres_mm[self.raw(features).argmax(dim=1)]

    def loss(self, batch: Batch) -> Tensor:
        """Return the cross-entropy of zone or key."""
        position_mm = (batch.position.numpy() + 0.5) * np.array(self._description.plate.size_mm)
        labels = torch.from_numpy(classes(position_mm, self._description))
        return nn.functional.cross_entropy(self.raw(batch.features), labels)


class KeypadNetwork(PositionNetwork):
    """Estimates probabilities of keys from a position and its standard error.

    A key's probability is that of a Gaussian about the position to lie on the key. So any layout fits a network trained
    on the whole plate, and a touch near a key's border gets a low probability. The probabilities, including that of no
    key, add up to the finger confidence.
    """

    outputs = ("probability",)
    low_mm: Tensor
    high_mm: Tensor

    def __init__(self, d: Description, layout: Layout, widths: tuple[int, ...], drift: Tensor) -> None:
        keys_mm = torch.tensor([[k.x_mm, k.y_mm, k.x_mm + k.width_mm, k.y_mm + k.height_mm] for k in layout.key])
        area_mm = torch.stack([keys_mm[:, :2].amin(dim=0) - BESIDE_MM, keys_mm[:, 2:].amax(dim=0) + BESIDE_MM])
        # One probability cannot separate noise, so typical noise is part of sigma.
        super().__init__(d.inputs, d.plate.size_mm, widths, drift, area_mm, noise_apart=False)
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


def make_network(recipe: Recipe, d: Description, drift: Tensor) -> Network:
    """Return the untrained network of a recipe for a model's description; it projects out `drift` (k, inputs)."""
    size_mm = d.plate.size_mm
    if d.head == "regression" and recipe.paper:
        return PaperNetwork(d.inputs, size_mm, recipe.widths)
    if d.head == "regression":
        return PositionNetwork(d.inputs, size_mm, recipe.widths, drift)
    if recipe.paper:
        return Classifier(d, recipe.widths, DROPOUT)
    if d.layout is not None:
        return KeypadNetwork(d, d.layout, recipe.widths, drift)
    return Classifier(d, recipe.widths, drift=drift)
