"""How many fingers, asked again: in pieces that no frame waits for long, and never in vain for ever."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from tests.fields import Field, Finger, make_atlas
from touchd.localization.gauss_newton import NO_FIT, STILL_MM, Fit, Refiner
from touchd.localization.multitouch import FITS_A_SECOND, FITS_AT_ONCE, Recount
from touchd.localization.noise import Hearing
from touchd.localization.pursuit import Search
from touchd.localization.spline import Place

FIELD = Field()
ATLAS = make_atlas(FIELD)
DEVIATION = 4.0
FOUR: list[Finger] = [(25.0, 25.0, 1 + 0j), (90.0, 30.0, 0.8 + 0.1j), (60.0, 65.0, 1.1 - 0.1j), (25.0, 70.0, 0.9 + 0j)]


class Rig:
    """A recount that counts the fits of each look."""

    def __init__(self) -> None:
        self.refiner, self.hearing = Refiner(ATLAS), Hearing(ATLAS)
        rng = np.random.default_rng(0)
        for _ in range(64):
            self.hearing.hear((DEVIATION * rng.standard_normal(ATLAS.size)).astype(np.float32))
        self.hearing.listen_to(np.ones(4, bool), np.zeros((0, ATLAS.size), np.float32))
        self.search = Search(ATLAS, Refiner(ATLAS))
        self.recount = Recount(self.refiner, self.search, self.hearing)
        self.fits = 0
        several = self.search._refiner.several

        def counted(places_mm: Sequence[Place], steps: int, still_mm: float = STILL_MM / 10) -> Fit:
            self.fits += 1
            return several(places_mm, steps, still_mm)

        self.search._refiner.several = counted  # type: ignore[method-assign]  # to count

    def show(self, fingers: list[Finger], seed: int = 1) -> float:
        """Take in a frame, and return the energy of its signal."""
        self.refiner.frame[:] = FIELD.frame(fingers, DEVIATION, seed)
        return self.refiner.take() - self.hearing.expected

    def look(self, fingers: list[Finger], known: int, elapsed_s: float, seed: int = 1) -> Fit:
        """One frame in which some of the fingers are known; what is found."""
        signal = self.show(fingers, seed)
        fit = self.refiner.several([place[:2] for place in fingers[:known]], 3) if known else NO_FIT
        fit = fit if known else replace(fit, left=self.refiner.energy)
        self.fits = 0
        if self.recount.is_due(self.hearing.excess(fit.left, signal), signal, elapsed_s):
            fit, _ = self.recount.look(fit, signal, elapsed_s, followed=known > 0)
        return fit


def found(fit: Fit, fingers: list[Finger]) -> bool:
    return len(fit.places_mm) == len(fingers) and all(
        min(math.hypot(x - a, y - b) for a, b in fit.places_mm) < 0.3 for x, y, _ in fingers
    )


@pytest.mark.parametrize("elapsed_s", [0.001, 0.002, 0.032])
def test_while_fingers_are_followed_no_frame_waits_for_more_fits_than_its_time_allows(elapsed_s: float) -> None:
    rig = Rig()
    for seed in range(1, 60):
        fit = rig.look(FOUR, 1, elapsed_s, seed)
        assert rig.fits <= FITS_A_SECOND * elapsed_s + 2
        if not rig.recount.pending:
            break
    assert (seed > 1) is (elapsed_s < 0.032), "the shorter the frames, the more of them it takes"
    assert found(fit, FOUR)


def test_fingers_that_come_together_are_found_in_the_frame_in_which_they_come() -> None:
    rig = Rig()
    assert found(rig.look(FOUR, 0, 0.001), FOUR)
    assert rig.fits <= FITS_AT_ONCE + 2
    assert not rig.recount.pending


def test_a_frame_by_itself_is_searched_to_the_end() -> None:
    rig = Rig()
    assert found(rig.look(FOUR, 1, 0.0), FOUR)
    assert not rig.recount.pending


def test_fingers_that_move_during_a_search_are_found_where_they_are_at_its_end() -> None:
    rig = Rig()
    for i in range(40):
        moved = [(x + 0.05 * i, y - 0.04 * i, z) for x, y, z in FOUR[:2]]
        fit = rig.look(moved, 1, 0.001, seed=i)
        if len(fit.places_mm) == 2:
            break
    assert i > 1
    assert found(fit, moved)


def test_what_nothing_explains_is_searched_ever_more_seldom_unless_it_grows() -> None:
    rig, rng = Rig(), np.random.default_rng(3)
    palm = 300 * rng.standard_normal(ATLAS.size)
    searches, since = [], 0.0

    def frame(scale: float) -> bool:
        rig.refiner.frame[:] = scale * palm
        signal = rig.refiner.take() - rig.hearing.expected
        fit = replace(NO_FIT, left=rig.refiner.energy)
        due = rig.recount.is_due(rig.hearing.excess(fit.left, signal), signal, 0.05)
        if due:
            rig.recount.look(fit, signal, 0.0, followed=False)
        return due

    for _ in range(200):
        since += 0.05
        if frame(1.0):
            searches.append(since)
            since = 0.0
    assert len(searches) < 15
    assert searches[-1] == pytest.approx(2.0, abs=0.06)
    assert not frame(1.2)
    assert frame(2.0), "four times the energy"


def test_a_finger_that_explains_next_to_nothing_is_none() -> None:
    rig = Rig()
    signal = rig.show(FOUR[:2])
    fit = rig.refiner.several([(25.0, 25.0), (60.0, 40.0), (90.0, 30.0)], 3)
    pruned, dropped = rig.recount.prune(fit, signal)
    assert dropped == [1]
    assert found(pruned, FOUR[:2])
    one = rig.refiner.several([(25.0, 25.0)], 3)
    assert rig.recount.prune(one, signal) == (one, [])


def test_an_abandoned_search_begins_anew() -> None:
    rig = Rig()
    rig.look(FOUR, 1, 0.001)
    pending = [rig.recount.pending]
    rig.recount.abandon()
    assert [*pending, rig.recount.pending] == [True, False]
    assert found(rig.look(FOUR, 1, 0.0), FOUR)
