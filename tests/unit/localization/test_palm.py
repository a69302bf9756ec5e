"""A palm's contacts are no fingers for as long as it lies on the plate, and no longer."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from touchd.localization.contact_model import LARGE_MM2
from touchd.localization.fit import Fit, no_fit
from touchd.localization.palm import (
    EVERYWHERE,
    FADES,
    GONE_NS,
    HUGE_SIZE,
    LANDS_NS,
    LARGE_SIZE,
    LARGE_TOGETHER,
    LOST_NS,
    MOMENT_MM2,
    NOWHERE,
    POOR,
    POOR_SIZE,
    REACH_MM,
    RESTS_NS,
    SIZE,
    STAYS_NS,
    UNLIKE,
    UNLIKE_ALONE,
    Palm,
)
from touchd.localization.spline import Position
from touchd.touch import PalmArea

HEEL, BALL, NEAR, FAR = (100.0, 100.0), (110.0, 70.0), (60.0, 90.0), (90.0 + 1.2 * REACH_MM, 90.0)
FRAME_NS = 8_000_000


def fit_of(moments_mm2: dict[Position, float], size: float) -> Fit:
    """Contacts of one amplitude with these mean moments."""
    shapes = [[0j, moment * size + 0j, moment * size + 0j, 0j] for moment in moments_mm2.values()]
    count = len(shapes)
    return Fit(list(moments_mm2), [size + 0j] * count, [size**2] * count, [], 0.0, shapes, [1 + 0j] * count)


def seen(fit: Fit, excess: float, between: tuple[tuple[Fit, float], ...] = ()) -> tuple[Palm, int | None]:
    """A palm's memory after frames of a fit, each followed by others, and when they were a palm's; None for 1 s."""
    palm, t_ns = Palm(), 0
    while t_ns < 1_000_000_000:
        if palm.contacts(fit, excess, 1.0, t_ns):
            return palm, t_ns
        for other, left in between:
            palm.miss(other, left, 1.0, t_ns)
        t_ns += FRAME_NS
    return palm, None


HUGE = fit_of({HEEL: 1.2 * MOMENT_MM2, BALL: 2.0, NEAR: 2.0}, 10.0)
THUMBS = fit_of({HEEL: 1.2 * LARGE_MM2, BALL: 1.2 * LARGE_MM2}, 0.6 * LARGE_TOGETHER)
APART = fit_of({FAR: 1.2 * LARGE_MM2, NEAR: 1.2 * LARGE_MM2}, 0.6 * LARGE_TOGETHER)
SMALLER = fit_of({HEEL: 0.9 * LARGE_MM2, BALL: 0.9 * LARGE_MM2}, LARGE_TOGETHER)
WELL, BADLY = 0.9 * UNLIKE, 1.1 * UNLIKE


def point(size: float) -> Fit:
    return Fit([HEEL], [size + 0j], [1.0], [], 0.0)


@pytest.mark.parametrize(
    ("fit", "excess", "is_palm"),
    [
        (HUGE, 0.0, True), (fit_of({HEEL: 0.95 * MOMENT_MM2, BALL: 2.0, NEAR: 2.0}, 10.0), 0.0, False),
        (fit_of({HEEL: 1.2 * MOMENT_MM2, BALL: 2.0}, 10.0), 0.0, False),
        (fit_of({HEEL: 2.0, BALL: 2.0, NEAR: 2.0}, 1.1 * HUGE_SIZE), 0.0, True),
        (fit_of({HEEL: 2.0, BALL: 2.0, NEAR: 2.0}, 0.9 * HUGE_SIZE), 0.0, False),
        (fit_of({HEEL: 1.2 * MOMENT_MM2, BALL: 2.0, NEAR: 2.0}, 0.95 * SIZE), BADLY, False),
        (THUMBS, BADLY, True), (THUMBS, WELL, False), (SMALLER, BADLY, False),
        (APART, BADLY, False), (APART, 0.9 * UNLIKE_ALONE, False), (APART, 1.1 * UNLIKE_ALONE, True),
        (fit_of({HEEL: 1.2 * LARGE_MM2}, 1.1 * LARGE_SIZE), 1.1 * UNLIKE_ALONE, True),
        (fit_of({HEEL: 1.2 * LARGE_MM2}, 1.1 * LARGE_SIZE), 0.9 * UNLIKE_ALONE, False),
        (fit_of({HEEL: 1.2 * LARGE_MM2}, 0.9 * LARGE_SIZE), 1.1 * UNLIKE_ALONE, False),
        (point(1.1 * POOR_SIZE), 1.1 * POOR, True), (point(0.9 * POOR_SIZE), 1.1 * POOR, False),
        (point(1.1 * POOR_SIZE), 0.9 * POOR, False),
    ],
)  # fmt: skip
def test_hand(fit: Fit, excess: float, is_palm: bool) -> None:
    """What is larger than a thumb, looks like thumbs that explain too little, or explains next to nothing.

    Two contacts alone are none, nor are two thumbs farther apart than heels are, nor faint ones, whose shapes are
    noise: two drops once hid fingers. It takes 50 ms.
    """
    _, after_ns = seen(fit, excess)
    assert (after_ns is not None) is is_palm
    assert after_ns is None or 0 <= after_ns - STAYS_NS < FRAME_NS


def test_in_between() -> None:
    """Frames without a fit, during a search, change nothing; a frame that fingers explain restarts the 50 ms."""
    assert seen(THUMBS, BADLY, ((no_fit(1.0), 1.0),))[1] is not None
    assert seen(THUMBS, BADLY, ((THUMBS, WELL),))[1] is None


def test_reach() -> None:
    """What lies within reach of the middle, where a light finger beside it weighs little, is the palm's alone."""
    palm, t_ns = seen(HUGE, 0.0)
    assert t_ns is not None
    beside = fit_of({NEAR: 2.0, HEEL: 1.2 * MOMENT_MM2, FAR: 2.0, BALL: 2.0}, 10.0)
    light = replace(beside, amplitudes=[z * (0.1 if k == 2 else 1.0) for k, z in enumerate(beside.amplitudes)])
    assert palm.contacts(light, 0.0, 1.0, t_ns + LANDS_NS) == {0, 1, 3}
    assert palm.area is not None
    assert palm.area.has(*BALL)
    assert not palm.area.has(*FAR)


FARTHER = (FAR[0] + 0.8 * REACH_MM, FAR[1])
FOREARM = fit_of({HEEL: 1.2 * MOMENT_MM2, BALL: 2.0, FAR: 2.0, FARTHER: 2.0}, 10.0)


def test_forearm() -> None:
    """What lands with a palm, each within reach of the next, are its parts; what lands later is a finger."""
    palm, t_ns = seen(HUGE, 0.0)
    assert t_ns is not None
    assert palm.contacts(FOREARM, 0.0, 1.0, t_ns + FRAME_NS) == {0, 1, 2, 3}
    later_ns = t_ns + 2 * LANDS_NS
    palm.see(later_ns)
    assert palm.area is not None
    assert palm.area.has(*FARTHER)
    away = fit_of({HEEL: 1.2 * MOMENT_MM2, BALL: 2.0, (HEEL[0], HEEL[1] + 1.4 * REACH_MM): 2.0}, 10.0)
    assert palm.contacts(away, 0.0, 1.0, later_ns) == {0, 1}


@pytest.mark.parametrize(("rested_ns", "is_part"), [(0.8 * RESTS_NS, True), (1.2 * RESTS_NS, False)])
def test_it_lands_beside_a_finger(rested_ns: float, is_part: bool) -> None:
    """A finger that has rested for a while is no part of a hand that lands beyond its reach; a hand's first one is."""
    beside = (BALL[0] + 0.9 * REACH_MM, BALL[1])
    palm, t_ns = Palm(), 0
    while t_ns < rested_ns:
        palm.contacts(fit_of({beside: 2.0}, 3.0), 0.0, 1.0, t_ns)
        t_ns += FRAME_NS
    landed = fit_of({beside: 2.0, HEEL: 1.2 * MOMENT_MM2, BALL: 2.0, NEAR: 2.0}, 10.0)
    landed = replace(landed, amplitudes=[3.0 + 0j, *landed.amplitudes[1:]])
    while not palm.area:
        of_palm = palm.contacts(landed, 0.0, 1.0, t_ns)
        t_ns += FRAME_NS
    assert of_palm == {1, 2, 3} | ({0} if is_part else set())


def test_middle() -> None:
    """Its middle is that of its contacts, however heavily each rests."""
    heavy = replace(HUGE, amplitudes=[20 + 0j, 5 + 0j, 2 + 0j])
    palm, _ = seen(heavy, BADLY)
    assert palm.area is not None
    assert (palm.area.x_mm, palm.area.y_mm) == pytest.approx((90.0, 260.0 / 3))


def missed(palm: Palm, t_ns: int, length_ns: int) -> tuple[int, PalmArea | None]:
    """Show frames of which nothing is placed; the time of the last one, and where the palm then lies."""
    stop_ns = t_ns + length_ns
    while t_ns < stop_ns:
        t_ns += FRAME_NS
        palm.miss(no_fit(1.0), 1.0, 1.0, t_ns)
    return t_ns, palm.area


def test_it_lands_fast() -> None:
    """A hand that is about to be known when nothing of it is placed any more is one, where it was seen."""
    palm = Palm()
    assert palm.contacts(HUGE, BADLY, 1.0, 0) == set()
    _, area = missed(palm, 0, STAYS_NS)
    assert area is not None
    assert area.has(*BALL)


def test_it_lands_at_once() -> None:
    """One of which nothing was ever placed is known, but not where it lies, until contacts explain the frame."""
    palm = Palm()
    t_ns, area = missed(palm, 0, LOST_NS - 2 * FRAME_NS)
    assert area is None, "it may be fingers that are searched for"
    t_ns, area = missed(palm, t_ns, 3 * FRAME_NS)
    assert area == NOWHERE
    assert palm.contacts(fit_of({BALL: 2.0, FAR: 2.0}, 3.0), WELL, 1.0, t_ns + FRAME_NS) == set()
    assert palm.area is None


@pytest.mark.parametrize(("beside_mm", "own"), [(None, {0, 1}), (FAR, {1})])
def test_it_lay_elsewhere(beside_mm: Position | None, own: set[int]) -> None:
    """What appears elsewhere in a frame, of which nothing was placed before, is what is left of it; a finger is not."""
    palm, t_ns = seen(HUGE, 0.0)
    assert t_ns is not None
    t_ns, _ = missed(palm, t_ns, 10 * FRAME_NS)
    left = fit_of({FAR: 2.0, (FAR[0], FAR[1] + 0.8 * REACH_MM * (2 if beside_mm else 1)): 2.0}, 3.0)
    assert palm.contacts(left, WELL, 1.0, t_ns + FRAME_NS, beside_mm) == own


def test_a_finger_beside_it() -> None:
    """A contact elsewhere of a frame in which it is seen, too, is a finger's, once it has landed."""
    palm, t_ns = seen(HUGE, 0.0)
    assert t_ns is not None
    t_ns, _ = missed(palm, t_ns, LANDS_NS)
    assert palm.contacts(fit_of({BALL: 2.0, FAR: 2.0}, 3.0), WELL, 1.0, t_ns + FRAME_NS) == {0}


def covered(palm: Palm, fit: Fit, excess: float, signal: float, frame: int) -> PalmArea | None:
    """What the palm covers in the next frame."""
    palm.contacts(fit, excess, signal, frame * FRAME_NS)
    return palm.covers


def test_covers() -> None:
    """Until it is known a palm may be anywhere, but not where the signal falls; then it covers its own reach alone."""
    palm = Palm()
    assert covered(palm, point(1.1 * POOR_SIZE), 0.0, 1.0, 0) is None
    assert covered(palm, THUMBS, BADLY, 2.0, 1) == EVERYWHERE
    assert covered(palm, THUMBS, BADLY, 1.0, 2) is None, "they lift"
    for frame in range(3, 20):
        covered(palm, THUMBS, BADLY, 1.0, frame)
    palm.miss(no_fit(1.0), 1.0, 1.0, 20 * FRAME_NS)
    assert palm.area is not None
    assert palm.covers == palm.area


def test_it_lifts() -> None:
    """Once it has lifted it is forgotten within 0.3 s, though drops stay where it lay."""
    palm, t_ns = seen(HUGE, 0.0)
    assert t_ns is not None
    ball = fit_of({BALL: 2.0}, 1.0)
    for _ in range(50):
        t_ns += FRAME_NS
        assert palm.contacts(ball, 0.0, 1.0, t_ns) == {0}
        palm.see(t_ns)
    assert palm.contacts(ball, 0.0, 1.0, t_ns + GONE_NS) == {0}
    assert palm.contacts(ball, 0.0, 1.0, t_ns + GONE_NS + 1) == set()
    assert palm.contacts(ball, 0.0, 1.0, t_ns + GONE_NS + 2) == set(), "it does not come back"


def test_nothing_placed() -> None:
    """A palm of which nothing can be placed stays known until what is left is explained."""
    palm, t_ns = seen(HUGE, 0.0)
    assert t_ns is not None
    for _ in range(100):
        t_ns += FRAME_NS
        palm.miss(no_fit(1.0), 1.0, 1.0, t_ns)
    ball = fit_of({BALL: 2.0}, 3.0)
    assert palm.contacts(ball, 0.0, 1.0, t_ns) == {0}
    assert palm.contacts(ball, 0.0, 1.0, t_ns + GONE_NS + 1) == set()
    assert palm.area is None


@pytest.mark.parametrize(("share", "forgotten"), [(1.1 * FADES, False), (0.9 * FADES, True)])
def test_what_it_leaves_is_no_palm(share: float, forgotten: bool) -> None:
    """A hand that has wiped the plate leaves it damp: nothing explains that, and it hid fingers where the hand was."""
    palm, t_ns = seen(HUGE, 0.0)
    assert t_ns is not None
    for _ in range(100):
        t_ns += FRAME_NS
        palm.miss(no_fit(share), 1.0, share, t_ns)
    assert palm.contacts(fit_of({BALL: 2.0}, 3.0), 0.0, 2.0, t_ns) == (set() if forgotten else {0})
