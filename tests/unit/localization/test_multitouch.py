"""The multi-touch search runs in pieces that no frame waits for long, and ever more seldom while in vain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from tests.fields import Field, Finger, bins_of, make_atlas
from touchd.localization.fit import Fit, no_fit
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.multitouch import LOOK_UPS_A_SECOND, MOST_LOOK_UPS, MultitouchSearch
from touchd.localization.noise import NoiseModel
from touchd.localization.pursuit import Pursuit
from touchd.localization.weighted_fit import WeightedFit

FIELD = Field()
ATLAS = make_atlas(FIELD)
SOLVER = GaussNewton(ATLAS)
DEVIATION = 4.0
FOUR: list[Finger] = [(25.0, 25.0, 1 + 0j), (90.0, 30.0, 0.8 + 0.1j), (60.0, 65.0, 1.1 - 0.1j), (25.0, 70.0, 0.9 + 0j)]


LARGEST = 30.0
"""Look-ups of the largest piece of a search for four fingers."""


class Counted(GaussNewton):
    """Counts the look-ups of a search."""

    look_ups = 0

    def _products(self, positions_mm: Any, shapes: Any, sizes: Any = ()) -> Any:
        self.look_ups += len(positions_mm)
        return super()._products(positions_mm, shapes, sizes)


class Rig:
    """A search that is shown frame after frame."""

    def __init__(self) -> None:
        self.noise, self.solver, self.t_ns = NoiseModel(ATLAS), Counted(ATLAS), 0
        rng = np.random.default_rng(0)
        for _ in range(64):
            self.noise.update((DEVIATION * rng.standard_normal(ATLAS.size)).astype(np.float32))
        self.noise.set_channels(np.ones(4, bool), np.zeros((0, ATLAS.size), np.float32))
        self.search = MultitouchSearch(SOLVER, Pursuit(ATLAS, self.solver), self.noise, WeightedFit(ATLAS))

    def see(
        self, features: np.ndarray, known: Sequence[Finger], after_ns: int, *, limited: bool = True,
        period_ns: int | None = None,
    ) -> Fit | None:  # fmt: skip
        """One frame in which some fingers are tracked; what is found, None if no search was due."""
        bins = bins_of(features)
        signal = bins.energy - self.noise.noise_energy
        fit = SOLVER.fit_several(bins, [finger[:2] for finger in known], 3) if known else no_fit(bins.energy)
        self.solver.look_ups, self.t_ns = 0, self.t_ns + after_ns
        self.search.update(self.t_ns, after_ns if period_ns is None else period_ns)
        if not self.search.is_due(self.noise.excess(fit.residual_energy, signal), signal):
            return None
        return self.search.search(bins, fit, signal, tracked=bool(known), limited=limited)[0]

    def look(self, fingers: list[Finger], known: int, after_ns: int, seed: int = 1, *, limited: bool = True) -> Fit:
        features = FIELD.frame(fingers, DEVIATION, seed)
        found = self.see(features, fingers[:known], after_ns, limited=limited)
        assert found is not None
        return found


def test_work_of_a_touch_after_a_pause() -> None:
    """However long the plate was untouched, a frame that shows a touch waits no longer than others at its rate."""
    rig = Rig()
    rig.see(FIELD.frame(FOUR, DEVIATION, 1), (), 10**10, period_ns=8_000_000)
    assert rig.solver.look_ups <= MOST_LOOK_UPS + LARGEST


def found(fit: Fit, fingers: list[Finger]) -> bool:
    return len(fit.positions_mm) == len(fingers) and all(
        min(math.hypot(x - a, y - b) for a, b in fit.positions_mm) < 0.3 for x, y, _ in fingers
    )


@pytest.mark.parametrize("frame_ns", [1_000_000, 4_000_000, 8_000_000, 16_000_000, 32_000_000, 800_000_000])
@pytest.mark.parametrize("known", [0, 1])
def test_work_of_a_frame(frame_ns: int, known: int) -> None:
    """No frame waits for more look-ups than its time allows, or than any may have; the search ends all the same."""
    rig = Rig()
    most = MOST_LOOK_UPS * max(min(frame_ns, 50_000_000) / 10_000_000, 1)
    allowed = min(LOOK_UPS_A_SECOND * frame_ns * 1e-9, most)
    for seed in range(1, 200):
        fit = rig.look(FOUR, known, frame_ns, seed)
        first = most if seed == 1 and not known else 0
        assert rig.solver.look_ups <= max(allowed, first) + LARGEST
        if not rig.search.pending:
            break
    assert seed > 1 or frame_ns > 8_000_000
    assert found(fit, FOUR)


def test_same_at_any_speed() -> None:
    """A search in pieces finds what one without limit finds."""
    whole, rig = Rig().look(FOUR, 0, 8_000_000, limited=False), Rig()
    fit = rig.look(FOUR, 0, 8_000_000)
    assert not fit.positions_mm, "nothing is said before it is known"
    while rig.search.pending:
        fit = rig.look(FOUR, 0, 8_000_000)
    np.testing.assert_allclose(sorted(fit.positions_mm), sorted(whole.positions_mm), atol=0.01)


def test_fingers_that_grow() -> None:
    """Fingers that were faint when the search began are found in a few frames once they are not."""
    rig = Rig()
    for seed, share in enumerate((0.02, 0.1, 0.4, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0), 1):
        fit = rig.look([(x, y, share * z) for x, y, z in FOUR], 0, 8_000_000, seed)
        if not rig.search.pending and share == 1.0:
            break
    assert found(fit, FOUR)


@pytest.mark.parametrize("after_ns", [8_000_000, 0, -5_000_000_000])
def test_without_limit(after_ns: int) -> None:
    """A search without limit ends in its frame, and a clock that stands or steps back makes no search limitless."""
    rig = Rig()
    assert found(rig.look(FOUR, 1, after_ns, limited=False), FOUR)
    assert not rig.search.pending
    if after_ns <= 0:
        rig = Rig()
        rig.look(FOUR, 1, after_ns)
        assert rig.search.pending
        assert rig.solver.look_ups == 0


def test_moving_fingers() -> None:
    """Fingers that move during a search are found where they are at its end."""
    rig = Rig()
    for i in range(40):
        moved = [(x + 0.05 * i, y - 0.04 * i, z) for x, y, z in FOUR[:2]]
        fit = rig.look(moved, 1, 1_000_000, seed=i)
        if len(fit.positions_mm) == 2:
            break
    assert i > 1
    assert found(fit, moved)


def test_in_vain() -> None:
    """What nothing explains is searched ever more seldom, unless it grows."""
    rig, palm = Rig(), 300 * np.random.default_rng(3).standard_normal(ATLAS.size)
    due_ns = []
    for _ in range(120):
        if rig.see(palm, (), 50_000_000, limited=False) is not None:
            due_ns.append(rig.t_ns)
    assert len(due_ns) < 16
    assert due_ns[-1] - due_ns[-2] == pytest.approx(2_000_000_000, abs=60_000_000)
    assert rig.see(1.2 * palm, (), 50_000_000) is None
    assert rig.see(2.0 * palm, (), 50_000_000) is not None, "four times the energy"


def test_much_more() -> None:
    """What was searched in vain is searched again in the next frame once it is the first of a finger that lands."""
    rig, palm = Rig(), 300 * np.random.default_rng(3).standard_normal(ATLAS.size)
    assert rig.see(palm, (), 8_000_000, limited=False) is not None
    assert rig.see(1.9 * palm, (), 8_000_000, limited=False) is None
    assert rig.see(2.1 * palm, (), 8_000_000, limited=False) is not None
    assert rig.see(2.1 * palm, (), 8_000_000, limited=False) is None


def test_clock_steps_back_in_vain() -> None:
    """A clock that steps back by an hour does not put the next search off by an hour."""
    rig, palm = Rig(), 300 * np.random.default_rng(3).standard_normal(ATLAS.size)
    for _ in range(20):
        rig.see(palm, (), 50_000_000, limited=False)
    assert rig.see(palm, (), -3_600_000_000_000) is not None


def test_prune() -> None:
    """A finger that explains next to nothing is dropped."""
    rig = Rig()
    bins = bins_of(FIELD.frame(FOUR[:2], DEVIATION, 1))
    signal = bins.energy - rig.noise.noise_energy
    fit = SOLVER.fit_several(bins, [(25.0, 25.0), (60.0, 40.0), (90.0, 30.0)], 3)
    pruned, dropped = rig.search.count.prune(bins, fit, signal)
    assert dropped == [1]
    assert found(pruned, FOUR[:2])
    one = SOLVER.fit_several(bins, [(25.0, 25.0)], 3)
    assert rig.search.count.prune(bins, one, signal) == (one, [])


def test_cancel() -> None:
    """A cancelled search starts from the beginning."""
    rig = Rig()
    rig.look(FOUR, 1, 1_000_000)
    pending = [rig.search.pending]
    rig.search.cancel()
    assert [*pending, rig.search.pending] == [True, False]
    assert found(rig.look(FOUR, 1, 1_000_000, limited=False), FOUR)


def test_landing_at_the_end_of_a_search() -> None:
    """A search that begins as another ends has the allowance of its own frame, not what the other has left."""
    rig = Rig()
    rig.look(FOUR[:3], 0, 4_000_000, 1)
    rig.look(FOUR[:3], 0, 3_000_000, 2)
    rig.look(FOUR, 0, 4_000_000, 3)
    assert rig.solver.look_ups == 0, "the first search has ended, and another finger has come"
    assert rig.search.pending
    rig.look(FOUR, 0, 4_000_000, 4)
    assert 0 < rig.solver.look_ups <= LOOK_UPS_A_SECOND * 4e-3 + 2 * len(FOUR)
