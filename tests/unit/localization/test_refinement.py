"""Fingers that rest are placed once more, and stay there; those that move are not."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import pytest

from touchd.localization.fit import Bins, Fit
from touchd.localization.weighted_fit import HOLD_MM, SLOW_MM, Place, Refinement, WeightedFit

BY_MM, SIGMA_MM = (0.03, -0.04), 0.02
BINS = Bins(np.zeros(4, np.float32), None, 1.0)


class Weighted:
    """Stands in for the weighted fit: it moves every contact by `BY_MM`."""

    def __init__(self, *, finds: bool = True) -> None:
        self.finds, self.asked = finds, 0

    def place(self, _bins: Bins, fit: Fit, _variance: float) -> tuple[list[Place], float]:
        self.asked += 1
        if not self.finds:
            return [], 0.0
        return [Place(x + BY_MM[0], y + BY_MM[1], SIGMA_MM) for x, y in fit.positions_mm], 0.2


def refinement(weighted: Weighted) -> Any:
    return Refinement(cast(WeightedFit, weighted))


def fit(*at: tuple[float, float], shaped: bool = True) -> Fit:
    shapes = [[0j, 1 + 0j, 1 + 0j, 0j]] * len(at) if shaped else []
    return Fit(list(at), [1 + 0j] * len(at), [1.0] * len(at), (), 0.0, shapes)


def place(one: Any, what: Fit, *, new: bool = False, alone: bool = False) -> tuple[Any, Any]:
    fingers = [(k, 0.05, 1.0) for k in range(len(what.positions_mm))]
    return one.place(BINS, what, fingers, 1.0, new=new, alone=alone)  # type: ignore[no-any-return]


def moved(at: tuple[float, float]) -> tuple[float, float]:
    return at[0] + BY_MM[0], at[1] + BY_MM[1]


def test_rests() -> None:
    """From its second frame on a finger is where the weighted fit puts it, which is asked once, as sure as it says."""
    weighted = Weighted()
    one = refinement(weighted)
    at, fingers = place(one, fit((50.0, 50.0)), new=True)
    assert at == [(50.0, 50.0)], "it may still move"
    assert fingers == [(0, 0.05, 1.0)]
    for step in range(100):
        here = 50.0 + 0.005 * step, 50.0
        at, fingers = place(one, fit(here))
        assert at[0] == pytest.approx(moved(here))
        assert fingers == [(0, pytest.approx(SIGMA_MM), 1.0)]
    assert weighted.asked == 1


def test_lifts() -> None:
    """A finger that is less sure than when it was placed, as it lifts, is as much less sure where it was moved to."""
    one = refinement(Weighted())
    place(one, fit((50.0, 50.0)), new=True, alone=True)
    _, fingers = one.place(BINS, fit((50.0, 50.0)), [(0, 0.5, 1.0)], 1.0, new=False, alone=False)
    assert fingers == [(0, pytest.approx(0.5 * SIGMA_MM / 0.05), 1.0)]


def test_alone() -> None:
    """A frame that is judged alone is placed at once."""
    at, _ = place(refinement(Weighted()), fit((50.0, 50.0), (90.0, 20.0)), new=True, alone=True)
    assert at == [moved((50.0, 50.0)), moved((90.0, 20.0))]


def test_moves() -> None:
    """A finger that moves is where it was fitted: the weighted fit is not asked until it is slow."""
    weighted = Weighted()
    one = refinement(weighted)
    for step in range(20):
        here = 50.0 + 1.5 * SLOW_MM * step, 50.0
        at, fingers = place(one, fit(here), new=step % 3 == 0)
        assert at == [here]
        assert fingers == [(0, 0.05, 1.0)]
    assert weighted.asked == 0
    at, _ = place(one, fit(here))
    assert at == [moved(here)]


def test_creeps() -> None:
    """A slow finger is placed again after each millimetre."""
    weighted = Weighted()
    one = refinement(weighted)
    place(one, fit((50.0, 50.0)), new=True)
    for step in range(1, 50):
        at, _ = place(one, fit((50.0 + 0.1 * step, 50.0)))
        assert math.dist(at[0], (50.0 + 0.1 * step, 50.0)) > 0
    assert weighted.asked == math.ceil(4.9 / HOLD_MM)


@pytest.mark.parametrize("what", [fit((50.0, 50.0), shaped=False), fit()])
def test_points(what: Fit) -> None:
    """Points are where they were fitted, and nothing of a finger before them is left."""
    weighted = Weighted()
    one = refinement(weighted)
    place(one, fit((50.0, 50.0)), new=True, alone=True)
    at, _ = place(one, what, new=True, alone=True)
    assert at == what.positions_mm
    assert weighted.asked == 1


def test_not_told() -> None:
    """Where the weighted fit finds no place, the fit's stays."""
    at, fingers = place(refinement(Weighted(finds=False)), fit((50.0, 50.0)), new=True, alone=True)
    assert at == [(50.0, 50.0)]
    assert fingers == [(0, 0.05, 1.0)]


def test_another_comes() -> None:
    """Two fingers are not where one was moved to."""
    one = refinement(Weighted())
    place(one, fit((50.0, 50.0)), new=True, alone=True)
    at, _ = place(one, fit((50.0, 50.0), (90.0, 20.0)), new=True)
    assert at == [(50.0, 50.0), (90.0, 20.0)]
