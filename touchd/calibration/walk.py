"""Walk a person through what tells how good a plate is, and label what was done.

Each act waits for its touch and ends with it, so that nobody needs a hand for the keyboard. An act that fails leaves
no frame: each frame of the recording belongs to an act that is complete.

Targets come in an order that covers the plate early, so that one may stop at any time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import Settings
from touchd.frame import Acquisition, Frame, Plate
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline
from touchd.recording.data import Act, Meta, Recording
from touchd.sources.recorder import recording_of

UNTOUCHED_S = 10.0
TAPS, THUMBS = 40, 8
STROKES = (((0.1, 0.3), (0.9, 0.3)), ((0.3, 0.1), (0.3, 0.9)), ((0.1, 0.1), (0.9, 0.9)), ((0.9, 0.1), (0.1, 0.9)),
           ((0.9, 0.7), (0.1, 0.7)), ((0.7, 0.9), (0.7, 0.1)))  # fmt: skip
"""Ends of the strokes, as shares of the sides."""
PALMS = ((0.5, 0.5), (0.4, 0.6), (0.6, 0.4))
"""Where a palm has room."""
CROSS_MM, RULER_MM, THUMB_MM, PALM_MM = 1.0, 2.0, 3.0, 30.0
"""How well a person hits a cross with a finger, keeps to a ruler, and hits with a thumb or a palm."""
TAP_S, STROKE_S, PALM_S = 0.1, 1.0, 1.0
"""A shorter touch does not count."""
BEFORE_S, AFTER_S = 1.0, 0.3
"""Untouched frames kept before a touch, and those that end it; a finger that bounces lifts for less."""
LONGEST_S = 30.0
"""A longer touch is an object on the plate."""
LEAST_BEFORE = 4
MARGIN = 2
"""Frames beside a touch that are labelled, too: in an untouched frame no finger comes near."""
FINGER = 3
"""Touched frames in a row that are a finger; fewer are an impulse."""
EDGE = 0.1
"""Share of a side that targets keep from each edge."""
REPEAT_EVERY, REPEAT_BACK = 5, 3
"""One target in five repeats an earlier one: two taps at one place tell how well a person hits."""
AGAIN_AFTER = 4
"""A target that was missed comes again after as many good taps."""
_PLASTIC = 1.32471795724474602596


def target_mm(index: int, width_mm: float, height_mm: float) -> tuple[float, float]:
    """Return the target of this number.

    The points of Roberts' R2 sequence (2018): of low discrepancy from the first on.
    """
    if index % REPEAT_EVERY == REPEAT_EVERY - 1:
        index -= REPEAT_BACK
    x, y = ((0.5 + (index + 1) / _PLASTIC**k) % 1 for k in (1, 2))
    return round(width_mm * (EDGE + (1 - 2 * EDGE) * x), 1), round(height_mm * (EDGE + (1 - 2 * EDGE) * y), 1)


def next_number(again: Iterable[Sequence[int]], upcoming: int, good: int) -> int:
    """Return the number of the target to tap after so many good taps: the first due one of `again`, else `upcoming`.

    `again` holds numbers of targets, each with the count of good taps from which on it is due.
    """
    return next((number for number, due in again if good >= due), upcoming)


class Task(NamedTuple):
    """One act to do."""

    name: str
    places_mm: tuple[tuple[float, float], ...]
    uncertainty_mm: float | None
    least_s: float
    """Shortest touch that counts; of an act without a touch, its duration."""

    @property
    def text(self) -> str:
        """What to do."""
        at = " to ".join(f"x {x_mm:g} y {y_mm:g} mm" for x_mm, y_mm in self.places_mm)
        return {
            "untouched": f"do not touch the plate for {self.least_s:g} s",
            "tap": f"mark a cross at {at}, and tap it with a fingertip for half a second",
            "stroke": f"lay a ruler from {at}, draw a finger along it in three seconds, then take the ruler away",
            "palm": f"lay your palm at {at} for three seconds",
            "thumb": f"tap with your thumb at {at}",
        }[self.name]


def plan(plate: Plate, untouched_s: float = UNTOUCHED_S) -> tuple[Task, ...]:
    """Return the acts for a plate, in an order in which one may stop early."""
    w, h = plate.size_mm
    acts = [Task("untouched", (), None, untouched_s)]
    acts += [Task("tap", (target_mm(k, w, h),), CROSS_MM, TAP_S) for k in range(TAPS)]
    for name, shares, uncertainty_mm, least_s in (
        *(("stroke", ends, RULER_MM, STROKE_S) for ends in STROKES),
        *(("palm", (place,), PALM_MM, PALM_S) for place in PALMS),
    ):
        places_mm = tuple((round(w * x, 1), round(h * y, 1)) for x, y in shares)
        acts.append(Task(name, places_mm, uncertainty_mm, least_s))
    acts += [Task("thumb", (target_mm(k, w, h),), THUMB_MM, TAP_S) for k in range(THUMBS)]
    return tuple(acts)


class Walk:
    """Takes frames, act by act."""

    def __init__(self, acquisition: Acquisition, tasks: Sequence[Task]) -> None:
        self.tasks = tasks
        self.next = 0
        """Index of the act in hand; `len(tasks)` at the end."""
        self.asked = 0
        """Counts the times that an act was begun, or begun again on demand."""
        self._done: dict[int, tuple[Task, list[Frame], NDArray[np.float32]]] = {}
        """The complete acts with their frames, and the labels of these, shape (n, 1, 2)."""
        self._pipeline = Pipeline(acquisition, None, Settings())
        self._try: deque[tuple[Frame, bool]] = deque()  # and whether it is touched
        self._last = (-1, -1)
        self._run = self._touched = 0

    def feed(self, frame: Frame) -> str:
        """Take a frame; return what to tell the person, or an empty text."""
        if frame.sequence <= self._last[0] or frame.t_ns <= self._last[1]:
            return ""
        self._last = frame.sequence, frame.t_ns
        outcome = self._pipeline.process(frame).outcome
        touched = outcome is Outcome.UNCALIBRATED
        if outcome is Outcome.LEARNING:
            self._restart()
        if not touched and outcome is not Outcome.UNTOUCHED:
            return ""
        self._run = self._run + 1 if touched else 0
        self._touched += touched
        self._try.append((frame.copy(), touched))
        task = self.tasks[self.next]
        return self._touch(task) if task.places_mm else self._untouched(task)

    def skip(self) -> None:
        """Leave the act in hand out."""
        self._go(min(self.next + 1, len(self.tasks)))

    def repeat(self) -> None:
        """Drop the act before, and do it again."""
        self._go(max(self.next - 1, 0))
        self._done.pop(self.next, None)

    def restart(self) -> None:
        """Begin the act in hand again and relearn the plate: the device was away."""
        self._pipeline.reset()
        self._go(self.next)

    @property
    def complete(self) -> int:
        """How many acts are complete."""
        return len(self._done)

    def count(self, name: str) -> tuple[int, int]:
        """Return how many acts of a name are complete, and how many there are."""
        return sum(task.name == name for task, *_ in self._done.values()), sum(t.name == name for t in self.tasks)

    def recording(self, meta: Meta) -> Recording | None:
        """Return the complete acts; None without one."""
        if not self._done:
            return None
        acts: list[Act] = []
        for task, frames, _ in self._done.values():
            begin = acts[-1].end if acts else 0
            acts.append(Act(name=task.name, begin=begin, end=begin + len(frames), places_mm=task.places_mm,
                            uncertainty_mm=task.uncertainty_mm))  # fmt: skip
        labels = [label for *_, label in self._done.values()]
        kept = [each for _, frames, _ in self._done.values() for each in frames]
        made = recording_of(meta.model_copy(update={"acts": tuple(acts)}), kept, kept[0].t_ns)
        return replace(made, contacts_mm=np.concatenate(labels))

    def _untouched(self, task: Task) -> str:
        if self._run >= FINGER:
            began = len(self._try) > FINGER
            self._restart()
            return "a finger: the seconds begin again" if began else ""
        if not self._run and self._span_s(0) >= task.least_s:
            self._complete(task)
        return ""

    def _touch(self, task: Task) -> str:
        if not self._touched:
            while self._span_s(0) > BEFORE_S:
                self._try.popleft()
            return ""
        if self._run:
            if self._span_s(0) < BEFORE_S + LONGEST_S:
                return ""
            self._restart()
            return "take everything off the plate"
        on = [k for k, (_, touched) in enumerate(self._try) if touched]
        if self._span_s(on[-1]) < AFTER_S:
            return ""
        if on[0] < LEAST_BEFORE or self._span_s(on[0]) - self._span_s(on[-1]) < task.least_s:
            self._restart()
            return "too short, or too soon: again" if len(on) >= FINGER else ""
        self._complete(task, on[0] - MARGIN, min(on[-1] + 1 + MARGIN, len(self._try)))
        return ""

    def _span_s(self, index: int) -> float:
        """Return the time from a frame of this try to the last one."""
        return (self._try[-1][0].t_ns - self._try[index][0].t_ns) * 1e-9

    def _complete(self, task: Task, first: int = 0, last: int = 0) -> None:
        """Keep an act; its frames from `first` to `last` are labelled, a stroke as if its speed were constant."""
        label = np.full((len(self._try), 1, 2), np.nan, np.float32)
        if last > first:
            label[first:last, 0] = np.linspace(task.places_mm[0], task.places_mm[-1], last - first)
        self._done[self.next] = task, [frame for frame, _ in self._try], label
        self._go(self.next + 1)

    def _go(self, act: int) -> None:
        self.next = act
        self.asked += 1
        self._restart()

    def _restart(self) -> None:
        self._try.clear()
        self._run = self._touched = 0
