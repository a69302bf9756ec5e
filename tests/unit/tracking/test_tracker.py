"""The tracker: one down, one up, and the same id in between."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchd.config.schema import TrackerSettings
from touchd.event import Contact
from touchd.touch import Touch
from touchd.tracking.assignment import assign
from touchd.tracking.one_euro import OneEuro
from touchd.tracking.tracker import Tracker

PERIOD_NS = 8_000_000
SETTINGS = TrackerSettings()


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
            report = self.tracker.update(self.t_ns, touches)
            if report:
                self.reports.append(report)

    def phases(self, contact_id: int = 1) -> list[str]:
        return [c.phase for report in self.reports for c in report if c.id == contact_id]


def test_a_finger_is_down_after_two_frames_and_up_after_two_without_it() -> None:
    stroke = Stroke()
    stroke.feed(at(50, 60))
    assert not stroke.reports
    stroke.feed(at(50, 60))
    assert stroke.phases() == ["down"]
    stroke.feed()
    assert stroke.phases() == ["down"]
    stroke.feed()
    assert stroke.phases() == ["down", "up"]
    assert not stroke.tracker.busy


places = st.lists(st.tuples(st.floats(0, 60), st.floats(0, 60)), min_size=1, max_size=5, unique=True)


@given(places, places)
def test_which_finger_is_which_is_decided_by_the_least_way_of_all_together(
    before: list[tuple[float, float]], after: list[tuple[float, float]]
) -> None:
    stroke, reach_mm = Stroke(), SETTINGS.reach_mm
    stroke.feed(*(at(*place) for place in before))
    touches = [at(*place) for place in after]
    found = stroke.tracker._match(touches)
    taken = [touch for touch in found if touch is not None]
    assert len(set(map(id, taken))) == len(taken)

    def way_mm(place: tuple[float, float], touch: Touch | None) -> float:
        return reach_mm if touch is None else math.dist(place, (touch.x_mm, touch.y_mm))

    ways_mm = [[way_mm(place, touch) for touch in touches] + [reach_mm] * len(before) for place in before]
    costs = [[way if way <= reach_mm else 1e9 for way in row] for row in ways_mm]
    least_mm = sum(row[j] for row, j in zip(costs, assign(costs), strict=True))
    assert sum(map(way_mm, before, found)) == pytest.approx(least_mm)


def test_a_single_frame_is_no_finger() -> None:
    stroke = Stroke()
    stroke.feed(at(50, 60))
    stroke.feed(frames=5)
    stroke.feed(at(50, 60))
    stroke.feed(frames=5)
    assert not stroke.reports


def test_one_missing_frame_does_not_split_a_contact() -> None:
    stroke = Stroke()
    for _ in range(20):
        stroke.feed(at(50, 60), frames=5)
        stroke.feed()
    assert {c.id for report in stroke.reports for c in report} == {1}
    assert stroke.phases().count("down") == 1


@pytest.mark.parametrize(("period_ns", "most_ns"), [(8_000_000, 96_000_000), (10_000_000, 100_000_000)])
def test_no_two_reports_of_a_still_finger_are_more_than_100_ms_apart(period_ns: int, most_ns: int) -> None:
    tracker, reported_ns = Tracker(SETTINGS), []
    for t_ns in range(period_ns, 2_000_000_000, period_ns):
        if tracker.update(t_ns, (at(50, 60),)):
            reported_ns.append(t_ns)
    assert set(np.diff(reported_ns)) == {most_ns}


def test_a_still_finger_is_reported_although_the_clock_steps_back() -> None:
    stroke = Stroke()
    stroke.t_ns = 10**15
    stroke.feed(at(50, 60), frames=20)
    stroke.t_ns = 0
    before = len(stroke.reports)
    stroke.feed(at(50, 60), frames=50)
    assert len(stroke.reports) > before + 3
    assert set(stroke.phases()) == {"down", "hold"}


def test_a_still_finger_is_reported_every_100_ms_and_held_where_it_was() -> None:
    stroke = Stroke()
    rng = np.random.default_rng(1)
    for _ in range(250):
        stroke.feed(at(*(np.array([50, 60]) + 0.05 * rng.standard_normal(2))))
    assert stroke.phases() == ["down"] + ["hold"] * (len(stroke.reports) - 1)
    assert len({(c.x_mm, c.y_mm) for report in stroke.reports for c in report}) == 1
    assert len(stroke.reports) == pytest.approx(250 * 0.008 / 0.096, abs=1)


def test_a_moving_finger_moves_with_its_velocity() -> None:
    stroke = Stroke()
    for i in range(100):
        stroke.feed(at(20 + 1.2 * i, 100))
    last = stroke.reports[-1][0]
    assert last.phase == "move"
    assert last.vx_mm_s == pytest.approx(150, rel=0.02)
    assert last.vy_mm_s == pytest.approx(0, abs=1)
    assert last.x_mm == pytest.approx(20 + 1.2 * 99, abs=1.5), "it lags by little"


def test_two_fingers_keep_their_ids_while_they_pass_each_other() -> None:
    stroke = Stroke()
    for i in range(60):
        a, b = at(20 + 2 * i, 90), at(140 - 2 * i, 110)
        stroke.feed(*((a, b) if i % 2 else (b, a)))
    ys = {c.id: c.y_mm for c in stroke.reports[-1]}
    downs = {c.id: c.y_mm for c in stroke.reports[0]}
    assert ys == pytest.approx(downs, abs=0.5)


def test_a_finger_that_lands_far_away_is_another_contact() -> None:
    stroke = Stroke()
    stroke.feed(at(20, 20), frames=5)
    stroke.feed(at(150, 150), frames=5)
    assert stroke.phases(1)[-1] == "up"
    assert stroke.phases(2)[0] == "down"


def test_losing_the_source_lifts_every_contact() -> None:
    stroke = Stroke()
    stroke.feed(at(20, 20), at(120, 120), frames=5)
    report = stroke.tracker.release_all(stroke.t_ns)
    assert report is not None
    assert [c.phase for c in report] == ["up", "up"]
    assert not stroke.tracker.busy
    assert stroke.tracker.release_all(stroke.t_ns) is None


def test_a_report_does_not_change_after_it_was_made() -> None:
    stroke = Stroke()
    stroke.feed(at(20, 20), frames=2)
    first = stroke.reports[0][0]
    stroke.feed(at(30, 20), frames=3)
    assert (first.phase, first.x_mm) == ("down", 20)


_touches = st.lists(
    st.builds(at, st.floats(0, 200), st.floats(0, 200)), max_size=6, unique_by=lambda t: (t.x_mm, t.y_mm)
)


@given(st.lists(_touches, max_size=60))
@settings(max_examples=150, deadline=None)
def test_whatever_comes_each_contact_goes_down_once_and_up_once(frames: list[list[Touch]]) -> None:
    stroke = Stroke(TrackerSettings(max_contacts=4))
    for touches in frames:
        stroke.feed(*touches)
    end = stroke.tracker.release_all(stroke.t_ns + PERIOD_NS)
    if end:
        stroke.reports.append(end)
    story: dict[int, list[str]] = {}
    for report in stroke.reports:
        assert len(report) <= 2 * 4
        for c in report:
            story.setdefault(c.id, []).append(c.phase)
            assert all(map(math.isfinite, (c.x_mm, c.y_mm, c.vx_mm_s, c.vy_mm_s)))
    for phases in story.values():
        assert phases[0] == "down"
        assert phases[-1] == "up"
        assert phases.count("down") == phases.count("up") == 1


@given(st.lists(st.tuples(st.floats(0, 200), st.floats(0, 200), st.floats(1e-6, 10)), min_size=1, max_size=50))
@settings(max_examples=100, deadline=None)
def test_the_filter_stays_inside_the_box_of_its_inputs(points: list[tuple[float, float, float]]) -> None:
    filtered = OneEuro(points[0][0], points[0][1], 4.0, 0.2)
    for x_mm, y_mm, elapsed_s in points[1:]:
        filtered.update(x_mm, y_mm, elapsed_s)
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    assert min(xs) - 1e-9 <= filtered.x_mm <= max(xs) + 1e-9
    assert min(ys) - 1e-9 <= filtered.y_mm <= max(ys) + 1e-9


def test_the_filter_does_not_depend_on_the_direction_of_a_stroke() -> None:
    along, across = OneEuro(0, 0, 4.0, 0.2), OneEuro(0, 0, 4.0, 0.2)
    for i in range(50):
        along.update(2.0 * i, 0, 0.008)
        across.update(math.sqrt(2) * i, math.sqrt(2) * i, 0.008)
    assert along.x_mm == pytest.approx(math.hypot(across.x_mm, across.y_mm))
