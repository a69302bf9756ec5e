"""A finger is found beside a palm that nothing explains, by what has changed, and nothing else is."""

from __future__ import annotations

import math

import pytest

from tests.fields import Finger
from tests.unit.localization.rig import Rig
from touchd.config.schema import ModelSettings
from touchd.localization.beside_palm import BEFORE_NS, REACH_MM, STILL_NS, STILL_REACH_MM
from touchd.localization.palm import NOWHERE
from touchd.touch import PalmArea, Touch

PALM = PalmArea(30.0, 45.0, 55.0)
PATCHES: list[Finger] = [
    (18.0, 30.0, 3 + 0.4j), (38.0, 25.0, 3 - 0.3j), (28.0, 45.0, 2.5 + 0j), (15.0, 60.0, 4 + 0.5j),
    (45.0, 62.0, 3.5 + 0j),
]  # fmt: skip
"""More than are searched for, beside a finger."""
FINGER: Finger = (95.0, 50.0, 1 + 0.05j)
NEAR: Finger = (PALM.x_mm + (STILL_REACH_MM + PALM.reach_mm) / 2, 50.0, 1 + 0.05j)
STILL = (STILL_NS + 2 * BEFORE_NS) // 4_000_000
SETTLED = 2 * BEFORE_NS // 4_000_000


class Beside:
    """Shows frames of a palm, which moves by 0.2 mm a second, and what else there is."""

    def __init__(self) -> None:
        self.rig = Rig()
        self.rig.lift(20)
        self.limits = ModelSettings()
        self._moved_mm = 0.0

    def see(self, *fingers: Finger, palm: PalmArea | None = PALM, patches: bool = True) -> tuple[Touch, ...]:
        self._moved_mm += 0.2 * self.rig.frame_ns * 1e-9
        moved = [(x + self._moved_mm, y, z) for x, y, z in PATCHES] if patches else []
        detection = self.rig.detection(self.rig.residual(*moved, *fingers))
        localizer = self.rig.localizer
        touches: tuple[Touch, ...] = localizer._beside.add(detection, (), palm, localizer._touch_maker, self.limits)
        return touches

    def rest(self, *fingers: Finger, frames: int = SETTLED) -> list[tuple[Touch, ...]]:
        return [self.see(*fingers) for _ in range(frames)]


@pytest.fixture
def beside() -> Beside:
    return Beside()


def test_it_lands_and_lifts(beside: Beside) -> None:
    """Within 20 ms of landing it is placed to 0.2 mm, for as long as it stays."""
    assert not any(beside.rest())
    assert any(beside.rest(FINGER, frames=5))
    for touches in beside.rest(FINGER, frames=50):
        (touch,) = touches
        assert math.dist((touch.x_mm, touch.y_mm), FINGER[:2]) < 0.2
        assert touch.sigma_mm < 1
    assert not any(beside.rest()[1:])
    assert any(beside.rest(FINGER, frames=5)), "and again"


def test_it_moves(beside: Beside) -> None:
    """It is followed."""
    beside.rest()
    beside.rest(FINGER, frames=8)
    for step in range(40):
        x, y, z = FINGER
        (touch,) = beside.see((x - 0.4 * step, y, z))
        assert math.dist((touch.x_mm, touch.y_mm), (x - 0.4 * step, y)) < 0.3


def test_what_lies_within_reach(beside: Beside) -> None:
    """The palm's own changes are none, nor is one that lands within its reach."""
    beside.rest()
    assert not any(beside.rest((50.0, 45.0, 1 + 0j), frames=30))


def test_near_a_hand_that_lies_still(beside: Beside) -> None:
    """One within reach is found if nothing has stirred for a while, and not after another has."""
    assert not any(beside.rest(frames=STILL))
    assert any(beside.rest(NEAR, frames=8))
    assert not any(beside.rest()[1:])
    assert not any(beside.rest(NEAR, frames=8)), "the first one has just lifted"
    beside.rest(frames=STILL)
    assert any(beside.rest(NEAR, frames=8))


def test_it_slides_onto_the_hand(beside: Beside) -> None:
    """A finger that comes as near as the hand's own contacts are ends."""
    beside.rest()
    assert any(beside.rest(FINGER, frames=8))
    x, y, z = FINGER
    seen = [beside.see((x - 0.8 * step, y, z)) for step in range(60)]
    assert not any(seen[-20:])


def test_a_hand_of_unknown_place(beside: Beside) -> None:
    """Beside it a finger is found anywhere, once nothing has stirred for a while."""

    def rest(*fingers: Finger, frames: int) -> bool:
        seen = [beside.see(*fingers, palm=NOWHERE) for _ in range(frames)]
        return any(seen)

    assert not rest(frames=SETTLED)
    assert not rest(NEAR, frames=8)
    assert not rest(frames=STILL)
    assert rest(NEAR, frames=8)


def test_one_that_lifts(beside: Beside) -> None:
    """A finger that lifts brings no touch: its change is a negative finger."""
    beside.rest(FINGER)
    assert not any(beside.rest())


def test_no_palm(beside: Beside) -> None:
    """Without a palm nothing is compared, and frames of before are forgotten."""
    beside.rest()
    assert not beside.see(FINGER, palm=None, patches=False)
    assert not beside.see(FINGER)
    assert not any(beside.rest(FINGER)), "there is nothing to compare it with"


def test_it_jumps(beside: Beside) -> None:
    """A finger that jumps farther than any finger moves in a frame ends; another touch is at the new place alone."""
    beside.rest()
    beside.rest(FINGER, frames=8)
    other: Finger = (95.0, 50.0 - 3 * REACH_MM, 1 + 0j)
    touches = beside.see(other)
    assert all(math.dist((touch.x_mm, touch.y_mm), other[:2]) < 0.5 for touch in touches)


@pytest.mark.parametrize("limit", [{"max_sigma_mm": 0.001}, {"min_confidence": 1.0}])
def test_limits(beside: Beside, limit: dict[str, float]) -> None:
    """The settings' least confidence and largest standard error hold here, too."""
    beside.limits = ModelSettings.model_validate(limit)
    beside.rest()
    assert not any(beside.rest(FINGER, frames=20))


def test_clock(beside: Beside) -> None:
    """A clock that goes back brings no finger."""
    beside.rest()
    beside.rig.t_ns = 0
    assert not beside.see(FINGER)
