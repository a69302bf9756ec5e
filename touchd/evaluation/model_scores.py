"""Score a model on single touches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.metrics import position_scores
from touchd.keypad import Layout
from touchd.localization.features import Features
from touchd.localization.model import Description, Model


@dataclass(frozen=True, slots=True)
class Judgement:
    """Estimates of a model for n touches, with the true positions."""

    true_mm: NDArray[np.float32]
    """True positions, shape (n, 2)."""
    position_mm: NDArray[np.float64]
    """Estimated positions, shape (n, 2)."""
    sigma_mm: NDArray[np.float64]
    """Predicted standard error per axis, shape (n,)."""
    confidence: NDArray[np.float64]
    """Shape (n,)."""
    true_class: NDArray[np.int64] | None = None
    """Grid and keypad heads: true zone or key, shape (n,); `keys` for a touch beside all keys."""
    found_class: NDArray[np.int64] | None = None
    """Estimated zone or key, shape (n,)."""
    keys: int = 0
    """Keypad head: number of keys."""

    @property
    def error_mm(self) -> NDArray[np.float64]:
        """Estimated less true position, shape (n, 2)."""
        return np.asarray(self.position_mm - self.true_mm)

    @property
    def distance_mm(self) -> NDArray[np.float64]:
        """Shape (n,)."""
        return np.asarray(np.linalg.norm(self.error_mm, axis=1))


def judge(model: Model, features: NDArray[np.float32], true_mm: NDArray[np.float32], noise_energy: float) -> Judgement:
    """Run a model on features of shape (n, inputs), one touch at a time as the daemon does.

    `noise_energy` is the energy of an untouched residual, ADC counts squared.
    """
    d = model.description
    route = Features(d.domain, d.acquisition, taper=d.taper)
    rows = np.empty((len(features), 4))
    found = np.zeros(len(features), np.int64) if d.head != "regression" else None
    for i, row in enumerate(features):
        model.features[0] = row
        estimate = model.estimate()
        sigma_mm = estimate.error_mm(route.noise_to_signal(noise_energy, float(row @ row)))
        rows[i] = estimate.x_mm, estimate.y_mm, sigma_mm, estimate.confidence
        if found is not None:
            found[i] = int(model.outputs["probability"][0].argmax())
    true = classes(true_mm, d) if found is not None else None
    keys = len(d.layout.key) if d.layout and d.head == "keypad" else 0
    return Judgement(true_mm, rows[:, :2], rows[:, 2], rows[:, 3], true, found, keys)


def classes(true_mm: NDArray[np.float32], description: Description) -> NDArray[np.int64]:
    """Return the true class of each position (n, 2): zone of a grid, or key of a layout."""
    if description.head == "keypad" and description.layout is not None:
        return labels_of(true_mm, description.layout)
    return zones_of(true_mm, description.grid, np.array(description.plate.size_mm))


def zones_of(position_mm: NDArray[np.floating], grid: int, size_mm: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the zone of each position (n, 2), row by row; `size_mm` (2,) is the plate's size."""
    column, row = np.clip(position_mm / size_mm * grid, 0, grid - 1e-6).astype(np.int64).T
    return np.asarray(row * grid + column)


def labels_of(position_mm: NDArray[np.floating], layout: Layout) -> NDArray[np.int64]:
    """Return the index of the key under each position (n, 2), or the number of keys beside all keys."""
    labels = np.full(len(position_mm), len(layout.key))
    exact_mm = position_mm.astype(np.float64)
    for number, key in reversed(list(enumerate(layout.key))):  # the first of overlapping keys wins, as in Layout.at
        offset_mm = exact_mm - [key.x_mm, key.y_mm]
        labels[((offset_mm >= 0) & (offset_mm < [key.width_mm, key.height_mm])).all(axis=1)] = number
    return labels


def key_scores(found: NDArray[np.int64], truth: NDArray[np.int64], keys: int) -> dict[str, float]:
    """Return the accuracy, and the number of touches of one key assigned to another; class `keys` means no key."""
    wrong = (found != truth) & (found != keys) & (truth != keys)
    return {"accuracy": float((found == truth).mean()), "key_to_key_errors": float(wrong.sum())}


def scores(judged: Judgement) -> dict[str, float]:
    """Return position scores, and those of sigma (regression) or of the classes (grid, keypad)."""
    found = position_scores(judged.error_mm) | {"confident": float((judged.confidence >= 0.5).mean())}
    if judged.true_class is None or judged.found_class is None:
        return found | {"within_sigma": float((np.abs(judged.error_mm) <= judged.sigma_mm[:, None]).mean())}
    of_keys = key_scores(judged.found_class, judged.true_class, judged.keys)
    return found | (of_keys if judged.keys else {"accuracy": of_keys["accuracy"]})
