"""Each contact goes down once and up once, with the same id in between."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from scipy.optimize import linear_sum_assignment

from touchd.config.schema import TrackerSettings
from touchd.event import Contact
from touchd.touch import Face, PalmArea, Touch
from touchd.tracking.one_euro import OneEuro
from touchd.tracking.tracker import Tracker

PERIOD_NS = 8_000_000
SETTINGS = TrackerSettings()


SURE = Touch(50, 60, 0.1, 0.995, 0.3)


def at(x_mm: float, y_mm: float) -> Touch:
    return Touch(x_mm, y_mm, 0.5, 0.99, 0.3)


class Stroke:
    """Feeds a tracker frame by frame and keeps what it reports."""

    def __init__(self, settings: TrackerSettings = SETTINGS) -> None:
        self.tracker = Tracker(settings)
        self.t_ns = 0
        self.reports: list[list[Contact]] = []

    def feed(self, *touches: Touch, frames: int = 1) -> None:
        for _ in range(frames):
            self.t_ns += PERIOD_NS
            if report := self.tracker.track(self.t_ns, touches):
                self.reports.append(report)

    def phases(self, contact_id: int = 1) -> list[str]:
        return [c.phase for report in self.reports for c in report if c.id == contact_id]


def test_down_and_up() -> None:
    """A finger is down after two frames with it, and up after two without it."""
    stroke = Stroke()
    stroke.feed(at(50, 60))
    assert not stroke.reports
    stroke.feed(at(50, 60))
    assert stroke.phases() == ["down"]
    stroke.feed()
    assert stroke.phases() == ["down"]
    stroke.feed()
    assert stroke.phases() == ["down", "up"]
    assert not stroke.tracker.alive


@pytest.mark.parametrize("lifted_frames", [0, 1])
def test_another_finger_lands_as_one_lifts(lifted_frames: int) -> None:
    """Typed keys that roll into one another are two contacts: a finger at rest does not leap to the next key.

    The key was lost, as its contact went on with the id of the one before and without a `down`.
    """
    stroke = Stroke()
    stroke.feed(SURE, frames=12)
    stroke.feed(frames=lifted_frames)
    stroke.feed(replace(SURE, x_mm=66), frames=4)
    assert stroke.phases(1)[-1] == "up"
    assert stroke.phases(2)[0] == "down"


@pytest.mark.parametrize(
    ("speed_mm_s", "acceleration_mm_s2"), [(2000.0, 0.0), (-1500.0, 20_000.0), (0.0, 50_000.0), (1000.0, -30_000.0)]
)
def test_a_quick_finger_is_one_contact(speed_mm_s: float, acceleration_mm_s2: float) -> None:
    """A finger that lands at 2 m/s, flicks from rest at five times gravity, or turns about, stays the same."""
    stroke = Stroke()
    if speed_mm_s == 0:
        stroke.feed(SURE, frames=12)
    for t_s in np.arange(10) * 0.008:
        stroke.feed(replace(SURE, x_mm=50 + speed_mm_s * t_s + acceleration_mm_s2 * t_s**2 / 2))
    assert {c.id for report in stroke.reports for c in report} == {1}
    assert "up" not in stroke.phases()


def test_a_finger_may_be_elsewhere_after_lost_frames() -> None:
    """After a fifth of a second without a frame one within the reach is the same."""
    stroke = Stroke()
    stroke.feed(SURE, frames=12)
    stroke.t_ns += 200_000_000
    stroke.feed(replace(SURE, x_mm=70), frames=4)
    assert "up" not in stroke.phases()
    assert not stroke.phases(2)


def test_sure_finger() -> None:
    """One frame is enough for a lone finger that is sure."""
    stroke = Stroke()
    stroke.feed(SURE)
    assert stroke.phases() == ["down"]
    stroke.feed(SURE, frames=2)
    stroke.feed(frames=2)
    assert stroke.phases() == ["down", "up"]


@pytest.mark.parametrize(
    "touches",
    [[replace(SURE, confidence=0.98)], [replace(SURE, sigma_mm=0.4)], [SURE, replace(SURE, x_mm=100)]],
    ids=["confidence", "sigma", "two"],
)
def test_unsure_fingers(touches: list[Touch]) -> None:
    """Fingers that are doubtful, or land together, are asked for again."""
    stroke = Stroke()
    stroke.feed(*touches)
    assert not stroke.reports
    stroke.feed(*touches)
    assert stroke.phases() == ["down"]


def test_sure_finger_beside_another() -> None:
    """A further finger is asked for again, however sure: it may be a part of the first."""
    stroke = Stroke()
    stroke.feed(SURE)
    stroke.feed(SURE, replace(SURE, x_mm=100))
    assert stroke.phases(2) == []
    stroke.feed(SURE, replace(SURE, x_mm=100))
    assert stroke.phases(2) == ["down"]


def test_sure_finger_after_a_lift() -> None:
    """A finger that shows once more while it lifts is no other one; after 0.1 s it is."""
    stroke = Stroke()
    stroke.feed(SURE, frames=3)
    stroke.feed(frames=2)
    stroke.feed(SURE)
    assert stroke.phases(2) == []
    stroke.feed(frames=13)
    stroke.feed(SURE)
    assert stroke.phases(2) == ["down"]


def test_more_frames_asked_for() -> None:
    """Who asks for more than two frames gets them from sure fingers too."""
    stroke = Stroke(TrackerSettings(confirm_frames=3))
    stroke.feed(SURE, frames=2)
    assert not stroke.reports
    stroke.feed(SURE)
    assert stroke.phases() == ["down"]


positions = st.lists(st.tuples(st.floats(0, 60), st.floats(0, 60)), min_size=1, max_size=5, unique=True)


@given(positions, positions)
def test_least_total_distance(before: list[tuple[float, float]], after: list[tuple[float, float]]) -> None:
    """Which finger is which is decided by the least total distance; a contact without a touch costs the reach."""
    # Nothing is smoothed, held back or late: each report has the positions as they came.
    unfiltered = TrackerSettings(confirm_frames=1, dead_band_mm=0).model_copy(update={"min_cutoff_hz": 1e15})
    stroke, reach_mm = Stroke(unfiltered), 25
    stroke.feed(*(Touch(*position, 0.0, 0.99, 0.3) for position in before))
    stroke.t_ns += 200_000_000
    stroke.feed(*(Touch(*position, 0.0, 0.99, 0.3) for position in after))
    down, then = ({c.id: (c.x_mm, c.y_mm) for c in report} for report in stroke.reports)
    assert set(then) >= set(down)
    unmatched = len(before) - (len(after) - (len(then) - len(down)))
    total_mm = sum(math.dist(down[i], then[i]) for i in down) + reach_mm * unmatched
    costs = [[math.dist(a, b) for b in after] + [reach_mm] * len(before) for a in before]
    costs = [[cost if cost <= reach_mm else 1e9 for cost in row] for row in costs]
    assert total_mm == pytest.approx(np.array(costs)[linear_sum_assignment(costs)].sum(), abs=1e-6)


def test_single_frame() -> None:
    """A finger seen in a single frame is not reported."""
    stroke = Stroke()
    stroke.feed(at(50, 60))
    stroke.feed(frames=5)
    stroke.feed(at(50, 60))
    stroke.feed(frames=5)
    assert not stroke.reports


def test_missing_frame() -> None:
    """One missing frame does not split a contact."""
    stroke = Stroke()
    for _ in range(20):
        stroke.feed(at(50, 60), frames=5)
        stroke.feed()
    assert {c.id for report in stroke.reports for c in report} == {1}
    assert stroke.phases().count("down") == 1


def test_clock_steps_back() -> None:
    """A still finger is reported although the clock steps back."""
    stroke = Stroke()
    stroke.t_ns = 10**15
    stroke.feed(at(50, 60), frames=20)
    stroke.t_ns = 0
    before = len(stroke.reports)
    stroke.feed(at(50, 60), frames=50)
    assert len(stroke.reports) > before + 3
    assert set(stroke.phases()) == {"down", "hold"}


def test_still_finger() -> None:
    """A still finger is reported every 100 ms, at one position."""
    stroke = Stroke()
    rng = np.random.default_rng(1)
    for _ in range(250):
        stroke.feed(at(*(np.array([50, 60]) + 0.05 * rng.standard_normal(2))))
    assert stroke.phases() == ["down"] + ["hold"] * (len(stroke.reports) - 1)
    assert len({(c.x_mm, c.y_mm) for report in stroke.reports for c in report}) == 1
    assert len(stroke.reports) == pytest.approx(250 * 0.008 / 0.096, abs=1)


def test_velocity() -> None:
    """A moving finger is reported with its velocity."""
    stroke = Stroke()
    for i in range(100):
        stroke.feed(at(20 + 1.2 * i, 100))
    last = stroke.reports[-1][0]
    assert last.phase == "move"
    assert last.vx_mm_s == pytest.approx(150, rel=0.02)
    assert last.vy_mm_s == pytest.approx(0, abs=1)
    assert last.x_mm == pytest.approx(20 + 1.2 * 99, abs=1.5), "it lags by little"


def test_passing_fingers() -> None:
    """Two fingers keep their ids while they pass each other."""
    stroke = Stroke()
    for i in range(60):
        a, b = at(20 + 2 * i, 90), at(140 - 2 * i, 110)
        stroke.feed(*((a, b) if i % 2 else (b, a)))
    ys = {c.id: c.y_mm for c in stroke.reports[-1]}
    downs = {c.id: c.y_mm for c in stroke.reports[0]}
    assert ys == pytest.approx(downs, abs=0.5)


@pytest.mark.parametrize("lost", [0, 1])
def test_fingers_in_line(lost: int) -> None:
    """Two fingers that swipe in line, farther from frame to frame than they are apart, keep their ids."""
    stroke = Stroke()
    apart_mm, way_mm, frames = 14.0, 120.0, 12 * (1 + lost)
    for k in [*[0] * 6, *range(0, frames, 1 + lost), *[frames] * 6]:
        along_mm = 50 + way_mm * (0.5 - 0.5 * math.cos(math.pi * k / frames))
        stroke.t_ns += lost * PERIOD_NS
        stroke.feed(at(along_mm, 60), at(along_mm + apart_mm, 60))
    assert [c.id for c in sorted(stroke.reports[-1], key=lambda c: c.x_mm)] == [1, 2]
    assert stroke.phases(1).count("down") == stroke.phases(2).count("down") == 1


@pytest.mark.parametrize("ahead_mm", [0.0, 0.5, 1.0])
def test_finger_that_lifts_near_another(ahead_mm: float) -> None:
    """A finger that lifts as it comes near another, which moves a little, ends, and the other one stays."""
    stroke = Stroke()
    for k in range(8):
        stroke.feed(at(20 + 10 * k, 60), at(100, 60))
    stroke.feed(at(100 - ahead_mm, 60), frames=3)
    assert stroke.phases(1)[-1] == "up"
    assert "up" not in stroke.phases(2)


def test_far_away() -> None:
    """A finger that lands far away is another contact."""
    stroke = Stroke()
    stroke.feed(at(20, 20), frames=5)
    stroke.feed(at(150, 150), frames=5)
    assert stroke.phases(1)[-1] == "up"
    assert stroke.phases(2)[0] == "down"


def test_palm() -> None:
    """Contacts that were a palm's end at once, and say so; those out of its reach do neither.

    Nor do those that were missing before the palm was there: they had lifted.
    """
    stroke = Stroke()
    stroke.feed(at(20, 20), at(50, 30), at(150, 150), frames=5)
    palm = PalmArea(30.0, 20.0, 60.0)
    report = stroke.tracker.track(stroke.t_ns + PERIOD_NS, [], palm)
    assert [(c.phase, c.kind) for c in report] == [("up", "palm"), ("up", "palm"), ("hold", None)]
    report = stroke.tracker.track(stroke.t_ns + 2 * PERIOD_NS, [], palm)
    assert [(c.phase, c.kind) for c in report] == [("up", None)]
    lifted = Stroke()
    lifted.feed(at(20, 20), frames=5)
    lifted.feed(frames=1)
    report = lifted.tracker.track(lifted.t_ns + PERIOD_NS, [], palm)
    assert [(c.phase, c.kind) for c in report] == [("up", None)]


def test_release_all() -> None:
    """Losing the source lifts every contact."""
    stroke = Stroke()
    stroke.feed(at(20, 20), at(120, 120), frames=5)
    report = stroke.tracker.release_all(stroke.t_ns)
    assert [c.phase for c in report] == ["up", "up"]
    assert not stroke.tracker.alive
    assert stroke.tracker.release_all(stroke.t_ns) == []


def test_report_is_final() -> None:
    """A report does not change after it was made."""
    stroke = Stroke()
    stroke.feed(at(20, 20), frames=2)
    first = stroke.reports[0][0]
    stroke.feed(at(30, 20), frames=3)
    assert (first.phase, first.x_mm) == ("down", 20)


_touches = st.lists(
    st.builds(at, st.floats(0, 200), st.floats(0, 200)), max_size=12, unique_by=lambda t: (t.x_mm, t.y_mm)
)


@given(st.lists(_touches, max_size=60))
def test_any_touches(frames: list[list[Touch]]) -> None:
    """Each contact goes down once and up once."""
    stroke = Stroke()
    for touches in frames:
        stroke.feed(*touches)
    stroke.reports.append(stroke.tracker.release_all(stroke.t_ns + PERIOD_NS))
    story: dict[int, list[str]] = {}
    for report in stroke.reports:
        assert len(report) <= 2 * 10
        for c in report:
            story.setdefault(c.id, []).append(c.phase)
            assert all(map(math.isfinite, (c.x_mm, c.y_mm, c.vx_mm_s, c.vy_mm_s)))
    for phases in story.values():
        assert phases[0] == "down"
        assert phases[-1] == "up"
        assert phases.count("down") == phases.count("up") == 1


@given(st.lists(st.tuples(st.floats(0, 200), st.floats(0, 200), st.floats(1e-6, 10)), min_size=1, max_size=50))
def test_filter_box(points: list[tuple[float, float, float]]) -> None:
    """The filter stays inside the box of its inputs."""
    filtered = OneEuro(points[0][0], points[0][1], 4.0, 0.2)
    for x_mm, y_mm, elapsed_s in points[1:]:
        filtered.update(x_mm, y_mm, elapsed_s)
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    assert min(xs) - 1e-9 <= filtered.x_mm <= max(xs) + 1e-9
    assert min(ys) - 1e-9 <= filtered.y_mm <= max(ys) + 1e-9


def test_filter_direction() -> None:
    """The filter does not depend on the direction of a stroke."""
    along, across = OneEuro(0, 0, 4.0, 0.2), OneEuro(0, 0, 4.0, 0.2)
    for i in range(50):
        along.update(2.0 * i, 0, 0.008)
        across.update(math.sqrt(2) * i, math.sqrt(2) * i, 0.008)
    assert along.x_mm == pytest.approx(math.hypot(across.x_mm, across.y_mm))


def test_settled() -> None:
    """A finger that rests in frames that are not examined is reported as one found anew in each, and so is its end."""
    rested, found = Stroke(), Stroke()
    face = Face(20.0, 1.0, 0.5, 0.5, 1.0)
    for x_mm, frames in ((50.0, 1), (50.6, 60), (50.6, 1), (52.0, 90), (52.0, 20)):
        touch = Touch(x_mm, 60.0, 0.05, 0.99, 0.3, None, replace(face, mean_mm2=0.4 * x_mm), "finger")
        rested.feed(touch, frames=frames)  # one tuple for all of them
        for _ in range(frames):
            found.feed(touch)
    for stroke in (rested, found):
        stroke.feed(frames=3)
    assert rested.phases() == found.phases()
    for mine, its in zip(rested.reports, found.reports, strict=True):
        assert mine[0].x_mm == pytest.approx(its[0].x_mm, abs=2e-3)
        assert mine[0].vx_mm_s == pytest.approx(its[0].vx_mm_s, abs=2e-3)
        assert mine[0].area_mm2 == pytest.approx(its[0].area_mm2, rel=0.02)
        assert mine[0].kind == its[0].kind


def test_frames_that_say_nothing() -> None:
    """A contact is kept through them, with messages as often as ever, but for no longer than 0.15 s."""
    stroke = Stroke()
    stroke.feed(at(50, 50), frames=4)
    before = len(stroke.reports)
    kept = 0
    while stroke.tracker.holds(stroke.t_ns + PERIOD_NS):
        stroke.t_ns += PERIOD_NS
        kept += 1
        if report := stroke.tracker.hold(stroke.t_ns):
            stroke.reports.append(report)
    assert kept == 18
    assert stroke.phases()[before:] == ["hold"], "one message in 0.1 s"
    stroke.feed(frames=2)
    assert stroke.phases()[-1] == "up"
    assert not stroke.tracker.holds(stroke.t_ns)


def test_frames_that_say_nothing_of_a_finger_that_has_just_landed() -> None:
    """It has landed once, however long nothing is known of it: a key is pressed once."""
    stroke = Stroke()
    stroke.feed(at(50, 50))
    while "down" not in stroke.phases():
        stroke.feed(at(50, 50))
    while stroke.tracker.holds(stroke.t_ns + PERIOD_NS):
        stroke.t_ns += PERIOD_NS
        stroke.reports += [report] if (report := stroke.tracker.hold(stroke.t_ns)) else []
    assert stroke.phases() == ["down", "hold"]
