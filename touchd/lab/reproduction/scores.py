"""Scores for the tables and plots."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.model_scores import Judgement, key_scores, labels_of, zones_of
from touchd.keypad import Layout


def zone_accuracy(judged: Judgement, grid: int, size_mm: tuple[float, float]) -> float:
    """Return the share of touches in the right zone, on a grid over a plate of this size."""
    true, found = (zones_of(each, grid, np.array(size_mm)) for each in (judged.true_mm, judged.position_mm))
    return float((true == found).mean())


def keys(judged: Judgement, layout: Layout) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return estimated and true key index of each touch (n,); the last index means beside all keys.

    A keypad estimates the key; for other models it is the key under the estimated position.
    """
    found = labels_of(judged.position_mm, layout) if judged.found_class is None else judged.found_class
    return found, labels_of(judged.true_mm, layout)


def keypad_scores(judged: Judgement, layout: Layout) -> dict[str, float]:
    """Return accuracy and key-to-key errors."""
    found, truth = keys(judged, layout)
    return key_scores(found, truth, len(layout.key))
