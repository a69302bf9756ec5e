"""Training objectives: loss, scores and metadata of each kind of network."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from touchd.errors import TrainingError
from touchd.evaluation.metrics import position_scores
from touchd.evaluation.model_scores import key_scores, labels_of, zones_of
from touchd.frame import Plate
from touchd.keypad import Layout
from touchd.training.network.network import PaperNetwork, PositionNetwork
from touchd.training.network.recipe import Recipe
from touchd.training.network.zones_and_keys import Classifier, KeypadNetwork, Network

DROPOUT = 0.3  # the paper's
SPREAD_BINS = 0.75  # deviation of the target histograms, from the HL-Gauss paper
WITHIN_SIGMA = 0.683  # share of errors per axis within sigma, as for Gaussian errors
FINGER_SHARE = 0.5  # weight of the finger cross-entropy relative to the position's

Positions = NDArray[np.float32]


class Batch(NamedTuple):
    """One training batch: n fingers, then m - n non-fingers."""

    features: Tensor
    """Shape (m, inputs), m >= n."""
    position: Tensor
    """Positions of the fingers relative to the plate's centre, in units of its size, shape (n, 2)."""
    noise: Tensor
    """Noise-to-signal ratio of the fingers' features, by norms, shape (n, 1); 0 if unknown."""


class Objective(Protocol):
    """Objective of a training loop."""

    wants_others: bool
    """Whether batches contain non-fingers."""

    @property
    def network(self) -> Network:
        """Network to train."""
        ...

    def loss(self, batch: Batch) -> Tensor:
        """Return the loss of a batch."""
        ...

    def scores(self, features: NDArray[np.float32], position_mm: Positions) -> dict[str, float]:
        """Return scores on touches, including `rmse_mm`."""
        ...

    def description(self) -> dict[str, Any]:
        """Return the model metadata that depend on the objective."""
        ...


class PositionObjective:
    """Position by histograms, standard error, and finger confidence."""

    wants_others = True

    def __init__(self, inputs: int, plate: Plate, recipe: Recipe, drift: Tensor) -> None:
        self.network = PositionNetwork(inputs, (plate.width_mm, plate.height_mm), recipe.widths, drift=drift)

    def loss(self, batch: Batch) -> Tensor:
        """Return position cross-entropy plus quantile loss of sigma plus finger cross-entropy."""
        features, position, noise = batch
        network, n = self.network, len(position)
        votes, log_error, logit = network.raw(features)
        votes = votes[:n]
        place = -(network.targets(position, SPREAD_BINS) * votes.log_softmax(dim=2)).sum(dim=2).mean()
        error_mm = (network.position_mm(votes.detach()) - network.truth_mm(position)).abs()
        sigma = _pinball((error_mm + 1e-3).log() - network.log_sigma(log_error[:n], noise), WITHIN_SIGMA)
        truth = (torch.arange(len(features)) < n).float()[:, None]
        finger = nn.functional.binary_cross_entropy_with_logits(logit, truth)
        return place + sigma + FINGER_SHARE * finger

    def scores(self, features: NDArray[np.float32], position_mm: Positions) -> dict[str, float]:
        """Return position scores and the share of confident touches."""
        with torch.inference_mode():
            estimated_mm, _, confidence, *_ = self.network.eval()(torch.from_numpy(features))
        confident = float((confidence.numpy() >= 0.5).mean())
        return position_scores(estimated_mm.numpy() - position_mm) | {"confident": confident}

    def description(self) -> dict[str, Any]:
        """Return no metadata: a regression needs none."""
        return {}


class PaperObjective:
    """Mean squared error of x and y, as in the paper."""

    wants_others = False

    def __init__(self, inputs: int, plate: Plate, recipe: Recipe) -> None:
        self.network = PaperNetwork(inputs, (plate.width_mm, plate.height_mm), recipe.widths, DROPOUT)

    def loss(self, batch: Batch) -> Tensor:
        """Return the mean squared error, in units of the plate's size."""
        return nn.functional.mse_loss(self.network.raw(batch.features), batch.position)

    def scores(self, features: NDArray[np.float32], position_mm: Positions) -> dict[str, float]:
        """Return position scores."""
        with torch.inference_mode():
            estimated_mm, _, _ = self.network.eval()(torch.from_numpy(features))
        return position_scores(estimated_mm.numpy() - position_mm)

    def description(self) -> dict[str, Any]:
        """Return no metadata: a regression needs none."""
        return {}


class KeyObjective(PositionObjective):
    """Keys from an estimated position: trained as a position, scored by keys."""

    network: KeypadNetwork

    def __init__(self, inputs: int, plate: Plate, recipe: Recipe, drift: Tensor, layout: Layout) -> None:
        self._layout = layout
        keys_mm = torch.tensor([[k.x_mm, k.y_mm, k.x_mm + k.width_mm, k.y_mm + k.height_mm] for k in layout.key])
        self.network = KeypadNetwork(inputs, (plate.width_mm, plate.height_mm), keys_mm, recipe.widths, drift=drift)

    def scores(self, features: NDArray[np.float32], position_mm: Positions) -> dict[str, float]:
        """Return position scores, accuracy, and touches of one key assigned to another."""
        network = self.network.eval()
        with torch.inference_mode():
            estimated_mm, *_ = PositionNetwork.forward(network, torch.from_numpy(features))
            probability = network(torch.from_numpy(features)).numpy()
            true_mm = network.truth_mm(torch.from_numpy(position_mm) / network.size_mm - 0.5)
        truth = labels_of(position_mm, self._layout)
        confident = float((probability.sum(axis=1) >= 0.5).mean())
        return (
            position_scores((estimated_mm - true_mm).numpy())
            | key_scores(probability.argmax(axis=1), truth, len(self._layout.key))
            | {"confident": confident}
        )

    def description(self) -> dict[str, Any]:
        """Return the layout."""
        return {"layout": self._layout}


class ClassObjective:
    """Cross-entropy of zones of a grid, or of keys and the area beside them.

    The position estimate is the centre of the most probable zone or key; beside the keys, the plate's centre.
    """

    wants_others = False

    def __init__(
        self, inputs: int, plate: Plate, recipe: Recipe, drift: Tensor, grid: int, layout: Layout | None
    ) -> None:
        self._size_mm = np.array([plate.width_mm, plate.height_mm])
        self._grid, self._layout = grid, layout
        if layout is None:
            step_mm = self._size_mm / grid
            rows, columns = np.divmod(np.arange(grid**2), grid)
            self._centres_mm = (np.stack([columns, rows], axis=1) + 0.5) * step_mm
        else:
            self._centres_mm = np.array([*(key.centre_mm for key in layout.key), tuple(self._size_mm / 2)])
        classes, dropout = len(self._centres_mm), DROPOUT if recipe.paper else 0.0
        self.network = Classifier(inputs, classes, recipe.widths, dropout, not recipe.paper, drift)

    def loss(self, batch: Batch) -> Tensor:
        """Return the cross-entropy of zone or key."""
        labels = self.labels((batch.position.numpy() + 0.5) * self._size_mm)
        return nn.functional.cross_entropy(self.network.raw(batch.features), torch.from_numpy(labels))

    def labels(self, position_mm: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
        """Return the class of each position, shape (n,)."""
        if self._layout is None:
            return zones_of(position_mm, self._grid, self._size_mm)
        return labels_of(position_mm, self._layout)

    def scores(self, features: NDArray[np.float32], position_mm: Positions) -> dict[str, float]:
        """Return accuracy, position scores, and for keys the touches of one key assigned to another."""
        with torch.inference_mode():
            best = self.network.eval().raw(torch.from_numpy(features)).argmax(dim=1).numpy()
        truth = self.labels(position_mm)
        scores = position_scores(self._centres_mm[best] - position_mm) | {"accuracy": float((best == truth).mean())}
        if self._layout is not None:
            scores |= key_scores(best, truth, len(self._layout.key))
        return scores

    def description(self) -> dict[str, Any]:
        """Return the grid or the layout."""
        return {"grid": self._grid} if self._layout is None else {"layout": self._layout}


def make_objective(
    recipe: Recipe, inputs: int, plate: Plate, grid: int, layout: Layout | None, drift: NDArray[np.float32]
) -> Objective:
    """Create the objective of a recipe; its network projects out `drift`, of shape (k, inputs).

    Raises
    ------
    TrainingError
        The grid has fewer than 2 zones per side, or a keypad has no layout.
    """
    if recipe.head == "keypad" and layout is None:
        raise TrainingError("a keypad recipe needs a layout", "--layout", "name a TOML file of keys")
    if recipe.head == "grid" and grid < 2:
        raise TrainingError(f"a grid of {grid} x {grid} zones has one class", "--n", "use 2 or more")
    directions = torch.from_numpy(drift)
    if recipe.head == "regression":
        return (
            PaperObjective(inputs, plate, recipe)
            if recipe.paper
            else PositionObjective(inputs, plate, recipe, directions)
        )
    if recipe.head == "keypad" and layout is not None:
        if not recipe.paper:
            return KeyObjective(inputs, plate, recipe, directions, layout)
        return ClassObjective(inputs, plate, recipe, directions, grid, layout)
    return ClassObjective(inputs, plate, recipe, directions, grid, None)


def _pinball(excess: Tensor, share: float) -> Tensor:
    """Return the quantile loss, least if this share of the excesses is negative (Koenker and Bassett 1978).

    Unlike a Gaussian likelihood, it ignores the size of the few errors of touches in a wrong lobe.
    """
    return torch.maximum(share * excess, (share - 1) * excess).mean()
