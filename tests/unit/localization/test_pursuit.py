"""Matching pursuit finds how many fingers there are, and where, in what of the frame is unexplained."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from tests.fields import BINS, Field, Finger, bins_of, in_double, make_atlas
from touchd.localization.fit import Fit, finish, no_fit
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.pursuit import Pursuit, apart_mm, are_merged, is_worth

FIELD = Field()
ATLAS = make_atlas(FIELD)
SOLVER = GaussNewton(ATLAS)
PURSUIT = Pursuit(ATLAS, SOLVER)
DEVIATION = 8.0
NOISE = ATLAS.size * DEVIATION**2


def fingers_of(count: int, seed: int, apart: float = 25.0) -> list[Finger]:
    rng = np.random.default_rng(seed)
    found: list[Finger] = []
    while len(found) < count:
        x, y = rng.uniform(10, 110), rng.uniform(10, 80)
        if all(math.hypot(x - a, y - b) > apart for a, b, _ in found):
            found.append((x, y, complex(rng.uniform(0.6, 1.4), rng.uniform(-0.2, 0.2))))
    return found


def searched(fingers: list[Finger], seed: int, deviation: float = DEVIATION) -> Fit:
    """What a search from nothing finds."""
    bins = bins_of(FIELD.frame(fingers, deviation, seed))
    return finish(PURSUIT.steps(bins, no_fit(bins.energy), ATLAS.size * deviation**2))


def all_found(fit: Fit, fingers: list[Finger], within_mm: float) -> bool:
    return len(fit.positions_mm) == len(fingers) and all(
        min(math.hypot(x - a, y - b) for a, b in fit.positions_mm) < within_mm for x, y, _ in fingers
    )


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_count(count: int) -> None:
    """Fingers well apart are counted and found in noise."""
    assert sum(all_found(searched(fingers_of(count, i), i), fingers_of(count, i), 0.5) for i in range(10)) >= 9


@pytest.mark.parametrize("count", [1, 3])
def test_complete_fit(count: int) -> None:
    """No finger is added to a complete fit."""
    for seed in range(10):
        fingers = fingers_of(count, seed)
        bins = bins_of(FIELD.frame(fingers, DEVIATION, seed))
        fit = SOLVER.fit_several(bins, [(x, y) for x, y, _ in fingers], 8)
        assert finish(PURSUIT.steps(bins, fit, NOISE)).positions_mm == fit.positions_mm


def test_swap() -> None:
    """One of five that is at a wrong place is moved to where a finger is missing."""
    for seed in range(5):
        fingers = fingers_of(5, seed)
        bins = bins_of(FIELD.frame(fingers, DEVIATION, seed))
        wrong = max(
            ((x, y) for x in (15.0, 60.0, 105.0) for y in (12.0, 45.0, 78.0)),
            key=lambda place: min(math.dist(place, finger[:2]) for finger in fingers),
        )
        fit = SOLVER.fit_several(bins, [wrong, *(finger[:2] for finger in fingers[1:])], 4)
        assert all_found(finish(PURSUIT._swap(bins, fit, NOISE)), fingers, 0.5)


def test_second_finger() -> None:
    """The second finger is added to one that is known."""
    for seed in range(10):
        fingers = fingers_of(2, seed)
        bins = bins_of(FIELD.frame(fingers, DEVIATION, seed))
        known = SOLVER.fit_one(bins, *fingers[0][:2], 5)
        assert all_found(finish(PURSUIT.steps(bins, known, NOISE)), fingers, 0.5)


@pytest.mark.parametrize("distance_mm", [1.0, 2.5, 3.0, 3.5])
def test_merged_fingers(distance_mm: float) -> None:
    """Two fingers nearer than 4 mm are one, between them, even in so little noise that two would explain more."""
    for seed in range(10):
        (x, y, z), *_ = fingers_of(1, seed)
        fit = searched([(x, y, z), (x + distance_mm, y, 0.8 * z)], seed, 1.0)
        assert len(fit.positions_mm) == 1
        assert math.dist(fit.positions_mm[0], (x + distance_mm / 2, y)) < 0.5 * distance_mm


def test_least_distance() -> None:
    """No two fingers that are found are nearer than merged ones."""
    assert all(apart_mm(searched(fingers_of(3, seed, 6.0), seed)) > 4.0 for seed in range(10))


@pytest.mark.parametrize(
    ("apart", "share", "followed", "merged"),
    [
        (0.75, 0.5, False, True), (0.85, 0.5, False, False), (0.95, 0.03, False, True), (1.05, 0.03, False, False),
        (0.65, 0.03, True, False), (0.55, 0.5, True, True),
    ],
)  # fmt: skip
def test_room(apart: float, share: float, followed: bool, merged: bool) -> None:
    """Two faces, `apart` in sums of their radii, are one where fingers have no room.

    One that is about to land is small: `share` is what it has of the energy. Those that are followed have to be nearer.
    """
    moment_mm2 = 4.0
    radius_mm = 3.7 * math.sqrt(moment_mm2)
    fit = Fit(
        [(50.0, 40.0), (50.0 + apart * 2 * radius_mm, 40.0)], [1 + 0j, 0.5 + 0j], [1.0 - share, share], (), 0.0,
        [[0j, z * moment_mm2, z * moment_mm2, 0j] for z in (1 + 0j, 0.5 + 0j)],
    )  # fmt: skip
    assert are_merged(fit, followed=followed) is merged


def test_noise_alone() -> None:
    """Noise is explained by one finger at most, of a few dozen variances; one of amplitude 1 explains thousands."""
    for seed in range(10):
        fit = searched([], seed)
        assert len(fit.positions_mm) <= 1
        assert sum(fit.energies) < 60 * DEVIATION**2


def test_candidates() -> None:
    """The candidates are those of a scan of the formula in float64, 7 mm apart; a float64 atlas gives the same."""
    double = Pursuit(in_double(ATLAS), GaussNewton(in_double(ATLAS)))
    for seed in range(5):
        features = FIELD.frame(fingers_of(1, seed), DEVIATION, seed)
        positions = PURSUIT.candidates(features.astype(np.float32))
        assert positions == double.candidates(features)
        assert 2 <= len(positions) <= 4
        assert min(math.dist(a, b) for a in positions for b in positions if a != b) >= 7.0
        parts = features.reshape(4, 2, len(BINS))
        data = parts[:, 0] + 1j * parts[:, 1]

        def score(x: float, y: float, data: np.ndarray = data) -> float:
            u = FIELD.at(x, y)[0]
            return float(abs(np.vdot(u, data)) ** 2 / np.vdot(u, u).real)

        scores = [score(*position) for position in positions]
        assert all(a > 0.98 * b for a, b in pairwise(scores))
        best = max(score(x, y) for x in np.arange(2.5, 118, 5) for y in np.arange(2.5, 88, 5))
        assert scores[0] == pytest.approx(best, rel=0.05)
        assert PURSUIT._scan(features.astype(np.float32)).max() == pytest.approx(scores[0], rel=0.05)


def test_nothing_left() -> None:
    """An empty frame has no candidates."""
    assert PURSUIT.candidates(np.zeros(ATLAS.size, np.float32)) == []


def test_worth() -> None:
    """Each further finger has to leave less than 0.42 of what was left without it."""

    def fit(count: int, left: float) -> Fit:
        return replace(no_fit(left), positions_mm=[(0.0, 0.0)] * count)

    assert is_worth(fit(2, 40.0), fit(1, 100.0), 0.0, 200.0)
    assert not is_worth(fit(2, 45.0), fit(1, 100.0), 0.0, 200.0)
    assert not is_worth(fit(3, 40.0), fit(1, 100.0), 0.0, 200.0), "two have to explain more than one"
    assert is_worth(fit(1, 99.0), fit(1, 100.0), 0.0, 200.0)
    assert apart_mm(fit(1, 0.0)) == apart_mm(fit(0, 0.0)) == math.inf
