"""How many fingers there are, and where, by what of the frame is not yet explained."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from tests.fields import BINS, Field, Finger, make_atlas
from touchd.localization.gauss_newton import Fit, Refiner
from touchd.localization.pursuit import Search, apart_mm, is_worth

FIELD = Field()
ATLAS = make_atlas(FIELD)
NONE = Fit([], [], [], np.zeros((0, 0)), 0.0)
DEVIATION = 8.0
NOISE = ATLAS.size * DEVIATION**2


def searching(features: np.ndarray) -> tuple[Refiner, Search]:
    refiner = Refiner(ATLAS)
    search = Search(ATLAS, refiner)
    refiner.frame[:] = features
    refiner.take()
    return refiner, search


def fingers_of(count: int, seed: int, apart: float = 25.0) -> list[Finger]:
    rng = np.random.default_rng(seed)
    found: list[Finger] = []
    while len(found) < count:
        x, y = rng.uniform(10, 110), rng.uniform(10, 80)
        if all(math.hypot(x - a, y - b) > apart for a, b, _ in found):
            found.append((x, y, complex(rng.uniform(0.6, 1.4), rng.uniform(-0.2, 0.2))))
    return found


def all_found(fit: Fit, fingers: list[Finger], within_mm: float) -> bool:
    return len(fit.places_mm) == len(fingers) and all(
        min(math.hypot(x - a, y - b) for a, b in fit.places_mm) < within_mm for x, y, _ in fingers
    )


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_fingers_well_apart_are_counted_and_found_in_noise(count: int) -> None:
    found = 0
    for seed in range(10):
        fingers = fingers_of(count, seed)
        refiner, search = searching(FIELD.frame(fingers, DEVIATION, seed))
        found += all_found(search.add(replace(NONE, left=refiner.energy), NOISE), fingers, 0.5)
    assert found >= 9


@pytest.mark.parametrize("count", [1, 3])
def test_to_a_fit_that_is_complete_none_is_added(count: int) -> None:
    for seed in range(10):
        fingers = fingers_of(count, seed)
        refiner, search = searching(FIELD.frame(fingers, DEVIATION, seed))
        fit = refiner.several([(x, y) for x, y, _ in fingers], 8)
        assert search.add(fit, NOISE).places_mm == fit.places_mm


def test_to_one_finger_that_is_known_the_second_is_added() -> None:
    for seed in range(10):
        fingers = fingers_of(2, seed)
        refiner, search = searching(FIELD.frame(fingers, DEVIATION, seed))
        assert all_found(search.add(refiner.one(*fingers[0][:2], 5), NOISE), fingers, 0.5)


@pytest.mark.parametrize("distance_mm", [1.0, 2.5, 3.0, 3.5])
def test_two_fingers_nearer_than_can_be_told_are_one(distance_mm: float) -> None:
    """Even in so little noise that two would explain more. The one lies between them."""
    for seed in range(10):
        (x, y, z), *_ = fingers_of(1, seed)
        refiner, search = searching(FIELD.frame([(x, y, z), (x + distance_mm, y, 0.8 * z)], 1.0, seed))
        fit = search.add(replace(NONE, left=refiner.energy), ATLAS.size)
        assert len(fit.places_mm) == 1
        assert math.dist(fit.places_mm[0], (x + distance_mm / 2, y)) < 0.5 * distance_mm


def test_of_many_fingers_none_are_nearer_than_merged_ones() -> None:
    for seed in range(10):
        refiner, search = searching(FIELD.frame(fingers_of(3, seed, 6.0), DEVIATION, seed))
        assert apart_mm(search.add(replace(NONE, left=refiner.energy), NOISE)) > 4.0


def test_noise_alone_is_explained_by_no_finger_to_speak_of() -> None:
    """One may be tried; it explains a few dozen variances, a finger of strength 1 thousands."""
    for seed in range(10):
        refiner, search = searching(FIELD.frame([], DEVIATION, seed))
        fit = search.add(replace(NONE, left=refiner.energy), NOISE)
        assert len(fit.places_mm) <= 1
        assert sum(fit.energies) < 60 * DEVIATION**2


def test_the_candidates_are_those_of_a_scan_in_float64_and_apart() -> None:
    for seed in range(5):
        fingers = fingers_of(1, seed)
        refiner, search = searching(FIELD.frame(fingers, DEVIATION, seed))
        found = search.candidates(refiner.frame)
        places = [candidate.place_mm for candidate in found]
        assert 2 <= len(places) <= 4
        assert min(math.dist(a, b) for a in places for b in places if a != b) >= 7.0
        bins = refiner.frame.reshape(4, 2, len(BINS)).astype(float)
        data = bins[:, 0] + 1j * bins[:, 1]

        def score(x: float, y: float, data: np.ndarray = data) -> float:
            u = FIELD.at(x, y)[0]
            return float(abs(np.vdot(u, data)) ** 2 / np.vdot(u, u).real)

        scores = [score(*place) for place in places]
        assert all(a > 0.98 * b for a, b in pairwise(scores))
        best = max(score(x, y) for x in np.arange(2.5, 118, 5) for y in np.arange(2.5, 88, 5))
        assert scores[0] == pytest.approx(best, rel=0.05)
        assert [candidate.energy for candidate in found] == pytest.approx(scores, rel=0.05)


def test_nothing_left_gives_no_candidates() -> None:
    _, search = searching(np.zeros(ATLAS.size))
    assert search.candidates(np.zeros(ATLAS.size, np.float32)) == []


def test_another_finger_has_to_earn_its_place() -> None:
    def fit(count: int, left: float) -> Fit:
        return replace(NONE, places_mm=[(0.0, 0.0)] * count, left=left)

    assert is_worth(fit(2, 40.0), fit(1, 100.0), 0.0)
    assert not is_worth(fit(2, 45.0), fit(1, 100.0), 0.0)
    assert not is_worth(fit(3, 40.0), fit(1, 100.0), 0.0), "two have to explain more than one"
    assert is_worth(fit(1, 99.0), fit(1, 100.0), 0.0)
    assert apart_mm(fit(1, 0.0)) == math.inf
    assert apart_mm(fit(0, 0.0)) == math.inf
