"""A walk keeps what was done as it was asked, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import numpy as np
import pytest

from touchd.calibration.walk import BEFORE_S, Task, Walk, plan
from touchd.frame import Acquisition, Frame, Plate
from touchd.recording.data import Recording, check
from touchd.sources.recorder import describe

ACQUISITION = Acquisition(channels=2, samples=50, sample_rate_hz=250e3)
PLATE = Plate(width_mm=300, height_mm=200)
META = describe(ACQUISITION, PLATE, 125.0, source="test")
PERIOD_NS = 8_000_000
TAP = Task("tap", ((30.0, 40.0),), 1.0, 0.1)
STROKE = Task("stroke", ((10.0, 20.0), (110.0, 20.0)), 2.0, 1.0)
UNTOUCHED = Task("untouched", (), None, 2.0)


class Hand:
    """Gives a walk noisy frames with a finger or without one."""

    def __init__(self, *tasks: Task) -> None:
        self.walk = Walk(ACQUISITION, tasks)
        self.rng = np.random.default_rng(1)
        self.plate, self.finger = 3000 * self.rng.standard_normal((2, *ACQUISITION.shape))
        self.numbers: Iterator[int] = count()
        self.said: list[str] = []

    def wait(self, seconds: float, force: float = 0.0) -> Hand:
        for _ in range(round(seconds * 125)):
            if self.walk.next < len(self.walk.tasks):
                noise = 3 * self.rng.standard_normal(ACQUISITION.shape)
                counts = (self.plate + force * self.finger + noise).astype(np.int16)
                number = next(self.numbers)
                self.said += filter(None, [self.walk.feed(Frame(counts, number, number * PERIOD_NS, 0))])
        return self

    def touch(self, seconds: float) -> Hand:
        return self.wait(seconds, 0.1)

    def recording(self) -> Recording:
        found = self.walk.recording(META)
        assert found is not None
        check(found)
        return found


def labelled(recording: Recording) -> int:
    assert recording.contacts_mm is not None
    return int(np.isfinite(recording.contacts_mm[:, 0, 0]).sum())


@pytest.mark.parametrize("plate", [PLATE, Plate(width_mm=40, height_mm=600)])
def test_plan(plate: Plate) -> None:
    """Every place lies on the plate, crosses keep from its edges, and it begins untouched."""
    tasks = plan(plate)
    assert tasks[0].name == "untouched"
    assert {task.name for task in tasks} == {"untouched", "tap", "stroke", "palm", "thumb"}
    size = np.array([plate.width_mm, plate.height_mm])
    for task in tasks[1:]:
        places = np.array(task.places_mm)
        assert (places >= 0.1 * size - 0.1).all()
        assert (places <= 0.9 * size + 0.1).all()
        assert len(places) == (2 if task.name == "stroke" else 1)
        assert all(f"x {x_mm:g} y {y_mm:g} mm" in task.text for x_mm, y_mm in task.places_mm)


def test_early_cover() -> None:
    """Whoever stops after eight taps has touched all four quarters of the plate."""
    places = np.array([task.places_mm[0] for task in plan(PLATE) if task.name == "tap"])[:8]
    assert {(x_mm > 150, y_mm > 100) for x_mm, y_mm in places.tolist()} == {(a, b) for a in (0, 1) for b in (0, 1)}


def test_tap() -> None:
    """A tap has its label in all frames of the finger, and untouched frames on both sides."""
    found = Hand(UNTOUCHED, TAP).wait(4).touch(0.4).wait(1).recording()
    assert found.contacts_mm is not None
    first, last = found.meta.acts
    assert (first.name, first.begin, last.name, last.end) == ("untouched", 0, "tap", len(found.frames))
    assert first.end == last.begin
    assert (last.places_mm, last.uncertainty_mm) == (TAP.places_mm, 1.0)
    on = np.flatnonzero(np.isfinite(found.contacts_mm[:, 0, 0]))
    assert 50 <= len(on) <= 56
    assert (found.contacts_mm[on, 0] == (30, 40)).all()
    assert last.begin + 20 < on[0]
    assert on[-1] + 20 < last.end


def test_waiting() -> None:
    """A long wait before a touch costs no more memory than a short one."""
    found = Hand(UNTOUCHED, TAP).wait(30).touch(0.4).wait(1).recording()
    act = found.meta.acts[1]
    assert act.end - act.begin < (BEFORE_S + 0.4 + 0.4) * 125
    assert found.sequence[act.begin] > found.sequence[act.begin - 1] + 1000


def test_finger_while_untouched() -> None:
    """A finger begins the untouched seconds again, and none of its frames is kept."""
    hand = Hand(UNTOUCHED).wait(1.5).touch(0.5).wait(4)
    assert hand.said == ["a finger: the seconds begin again"]
    found = hand.recording()
    assert found.sequence[0] > 1.9 * 125
    assert np.ptp(found.timestamp_ns) >= 2e9
    assert labelled(found) == 0


def test_short_touch() -> None:
    """A touch that is too short is told, and leaves no frame."""
    hand = Hand(UNTOUCHED, TAP).wait(4).touch(0.05).wait(1).touch(0.4).wait(1)
    assert hand.said == ["too short, or too soon: again"]
    assert 50 <= labelled(hand.recording()) <= 56


def test_stroke() -> None:
    """A stroke's rough label runs from the ruler's one end to the other, and is no touch to learn from."""
    found = Hand(UNTOUCHED, STROKE).wait(4).touch(2.0).wait(1).recording()
    assert found.contacts_mm is not None
    path = found.contacts_mm[np.isfinite(found.contacts_mm[:, 0, 0]), 0]
    assert path[0].tolist() == [10, 20]
    assert path[-1].tolist() == [110, 20]
    assert (np.diff(path[:, 0]) > 0).all()
    assert found.during("stroke").sum() == found.meta.acts[1].end - found.meta.acts[1].begin


def test_skip_and_repeat() -> None:
    """An act that is left out is missing; one that is repeated is there once, as it was done last."""
    hand = Hand(UNTOUCHED, TAP, STROKE, TAP).wait(4).touch(0.4).wait(1)
    hand.walk.repeat()
    hand.wait(1).touch(0.8).wait(1)
    hand.walk.skip()
    found = hand.wait(1).touch(0.4).wait(1).recording()
    assert [act.name for act in found.meta.acts] == ["untouched", "tap", "tap"]
    assert hand.walk.count("stroke") == (0, 1)
    assert 150 <= labelled(found) <= 162


def test_nothing() -> None:
    """Without a complete act there is nothing to save."""
    assert Hand(UNTOUCHED).wait(1).walk.recording(META) is None


def test_interrupted_act() -> None:
    """An act that is not complete leaves no frame."""
    hand = Hand(UNTOUCHED, TAP).wait(4).touch(0.4)
    assert [act.name for act in hand.recording().meta.acts] == ["untouched"]


def test_clock_goes_back() -> None:
    """Frames that a restarted device numbers from the start break no rule of the format."""
    hand = Hand(UNTOUCHED, TAP).wait(4)
    hand.numbers = count()
    hand.wait(6).touch(0.4).wait(1).recording()


def test_never_lifted() -> None:
    """What lies on the plate is no touch, and its frames are not piled up."""
    hand = Hand(UNTOUCHED, TAP).wait(4).touch(40)
    assert "take everything off the plate" in hand.said
    assert [act.name for act in hand.recording().meta.acts] == ["untouched"]
