"""What the tables and pictures say of what was measured."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.metrics import position_scores
from touchd.evaluation.model_scores import key_scores, labels_of
from touchd.keypad import Layout
from touchd.lab.reproduction.experiments import Data


def error_scores(data: Data) -> dict[str, float]:
    """Return the statistics of the position's error, in mm."""
    return position_scores(data["place_mm"] - data["truth_mm"])


def distance_mm(data: Data) -> NDArray[np.floating[Any]]:
    """Return the distances (n,) from the truth."""
    return np.asarray(np.linalg.norm(data["place_mm"] - data["truth_mm"], axis=1))


def zone_accuracy(data: Data, grid: int, size_mm: tuple[float, float]) -> float:
    """Return the share of touches whose own zone won, on a grid over a plate of this size."""
    zone_mm = np.array(size_mm) / grid
    return float((np.floor(data["truth_mm"] / zone_mm) == np.floor(data["place_mm"] / zone_mm)).all(axis=1).mean())


def keys(data: Data, layout: Layout) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the number of the key found and of the true one for each touch (n,), the last being beside all keys.

    A keypad names its key; of any other model it is the one under its position.
    """
    found = data["class"] if "class" in data else labels_of(data["place_mm"], layout)
    return np.asarray(found), labels_of(data["truth_mm"], layout)


def keypad_scores(data: Data, layout: Layout) -> dict[str, float]:
    """Return accuracy and key-to-key errors."""
    found, truth = keys(data, layout)
    return key_scores(found, truth, len(layout.key))


def confusion(data: Data, layout: Layout) -> NDArray[np.int64]:
    """Return how often each key (rows) was taken for each (columns), shape (keys + 1, keys + 1)."""
    found, truth = keys(data, layout)
    count = len(layout.key) + 1
    return np.bincount(truth * count + found, minlength=count**2).reshape(count, count)
