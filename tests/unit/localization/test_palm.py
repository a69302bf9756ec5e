"""A palm's contacts are no fingers for as long as it lies on the plate, and no longer."""

from __future__ import annotations

import pytest

from touchd.localization.classify import PALM_GONE_NS, PALM_MM2, PALM_REACH_MM, PALM_SIZE, Palm
from touchd.localization.fit import Fit
from touchd.localization.spline import Position

HEEL, BALL, NEAR, FAR = (100.0, 100.0), (110.0, 70.0), (60.0, 90.0), (100.0 + 1.01 * PALM_REACH_MM, 100.0)
FRAME_NS = 8_000_000


def fit_of(moments_mm2: dict[Position, float], size: float) -> Fit:
    """Contacts of one amplitude with these mean moments."""
    shapes = [[0j, moment * size + 0j, moment * size + 0j, 0j] for moment in moments_mm2.values()]
    count = len(shapes)
    return Fit(list(moments_mm2), [size + 0j] * count, [size**2] * count, [], 0.0, shapes, [1 + 0j] * count)


def test_reach() -> None:
    """What lies within a hand's reach of a contact larger than a thumb is the palm's, and a finger beyond it is not."""
    contacts = {NEAR: 2.0, HEEL: 1.2 * PALM_MM2, FAR: 2.0, BALL: 2.0}
    assert Palm().contacts(fit_of(contacts, 10.0), 0) == {0, 1, 3}


@pytest.mark.parametrize(
    ("largest_mm2", "size", "count"),
    [(0.95 * PALM_MM2, 10.0, 4), (1.2 * PALM_MM2, 10.0, 2), (1.2 * PALM_MM2, 0.95 * PALM_SIZE, 4)],
)
def test_no_palm(largest_mm2: float, size: float, count: int) -> None:
    """Thumbs are none, nor are two contacts, nor faint ones, whose shapes are noise: two drops once hid fingers."""
    contacts = dict(list({HEEL: largest_mm2, BALL: 2.0, NEAR: 2.0, FAR: 2.0}.items())[:count])
    assert Palm().contacts(fit_of(contacts, size), 0) == set()


def test_it_lifts() -> None:
    """Once it has lifted it is forgotten within 0.3 s, though drops stay where it lay."""
    palm, heel = Palm(), {HEEL: 1.2 * PALM_MM2, BALL: 2.0, NEAR: 2.0}
    ball, t_ns = fit_of({BALL: 2.0}, 1.0), 0
    assert palm.contacts(fit_of(heel, 10.0), t_ns) == {0, 1, 2}
    for _ in range(50):
        t_ns += FRAME_NS
        assert palm.contacts(ball, t_ns) == {0}
        palm.see(t_ns)
    assert palm.contacts(ball, t_ns + PALM_GONE_NS) == {0}
    assert palm.contacts(ball, t_ns + PALM_GONE_NS + 1) == set()
    assert palm.contacts(ball, t_ns + PALM_GONE_NS + 2) == set(), "it does not come back"
