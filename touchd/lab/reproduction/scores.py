"""Scores for the tables and plots."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.metrics import position_scores
from touchd.evaluation.model_scores import key_scores, labels_of
from touchd.keypad import Layout
from touchd.lab.reproduction.experiments import Data


def error_scores(data: Data) -> dict[str, float]:
    """Return the statistics of the position error, mm."""
    return position_scores(data["place_mm"] - data["truth_mm"])


def distance_mm(data: Data) -> NDArray[np.floating[Any]]:
    """Return the distances (n,) from the true positions."""
    return np.asarray(np.linalg.norm(data["place_mm"] - data["truth_mm"], axis=1))


def zone_accuracy(data: Data, grid: int, size_mm: tuple[float, float]) -> float:
    """Return the share of touches in the right zone, on a grid over a plate of this size."""
    zone_mm = np.array(size_mm) / grid
    return float((np.floor(data["truth_mm"] / zone_mm) == np.floor(data["place_mm"] / zone_mm)).all(axis=1).mean())


def keys(data: Data, layout: Layout) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return estimated and true key index of each touch (n,); the last index means beside all keys.

    A keypad estimates the key; for other models it is the key under the estimated position.
    """
    found = data["class"] if "class" in data else labels_of(data["place_mm"], layout)
    return np.asarray(found), labels_of(data["truth_mm"], layout)


def keypad_scores(data: Data, layout: Layout) -> dict[str, float]:
    """Return accuracy and key-to-key errors."""
    found, truth = keys(data, layout)
    return key_scores(found, truth, len(layout.key))
