"""Targets cover the plate early, and some come twice."""

from __future__ import annotations

import numpy as np

from touchd.calibration.walk import AGAIN_AFTER, REPEAT_BACK, REPEAT_EVERY, next_number, target_mm


def test_cover() -> None:
    """After 9 targets each third of each side has one; after 40 no place is further than a quarter of a side."""
    places = np.array([target_mm(k, 200.0, 100.0) for k in range(40)]) / [200.0, 100.0]
    assert (places > 0.05).all()
    assert (places < 0.95).all()
    for axis in (0, 1):
        assert len(set((places[:9, axis] * 3).astype(int).tolist())) == 3
    grid = np.stack(np.meshgrid(np.linspace(0.1, 0.9, 20), np.linspace(0.1, 0.9, 20)), -1).reshape(-1, 2)
    assert np.linalg.norm(grid[:, None] - places, axis=2).min(axis=1).max() < 0.25


def test_repeats() -> None:
    """One target in five is an earlier one; all others differ."""
    last = REPEAT_EVERY - 1
    assert target_mm(last, 200.0, 100.0) == target_mm(last - REPEAT_BACK, 200.0, 100.0)
    others = {target_mm(k, 200.0, 100.0) for k in range(100) if k % REPEAT_EVERY != last}
    assert len(others) == 80


def test_again() -> None:
    """A target that was missed comes again after four good taps at others, before new ones; until then new ones do."""
    again = [[3, 2 + AGAIN_AFTER], [5, 2 + AGAIN_AFTER]]
    assert [next_number(again, 6, good) for good in (2, 5)] == [6, 6]
    assert next_number(again, 9, 6) == 3
    assert next_number(again[1:], 9, 7) == 5
    assert next_number([], 9, 8) == 9
