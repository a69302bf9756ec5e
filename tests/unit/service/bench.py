"""A clock that stands still, a source that does what is written down, and a sink that keeps everything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

from msgspec.structs import replace

from touchd.event import Event, HealthEvent, TouchEvent
from touchd.frame import Frame
from touchd.recording.data import Recording
from touchd.service.runner import READ_TIMEOUT_S
from touchd.sources.source import Change, EndOfStream, Source

START_NS = 5_000_000_000
PERIOD_NS = 8_000_000
TIMEOUT_NS = round(READ_TIMEOUT_S * 1e9)

Step = Frame | None | Exception | Change


class Clock:
    """Monotonic time that stands still unless it is moved."""

    def __init__(self) -> None:
        self.now_ns = START_NS

    def __call__(self) -> int:
        return self.now_ns


class Script(Source):
    """A source that does what is written down: a frame each 8 ms, None after the timeout, or an error.

    A frame's `t_ns` is the clock, plus what is written down.
    """

    def __init__(self, recording: Recording, steps: Sequence[Step], clock: Clock) -> None:
        self.acquisition = recording.acquisition
        self.closed = 0
        self._steps = list(steps)
        self._clock = clock

    def read(self, timeout_s: float) -> Frame | None:
        step = self._steps.pop(0) if self._steps else EndOfStream()
        if isinstance(step, Exception):
            raise step
        if step is None:
            self._clock.now_ns += round(timeout_s * 1e9)
            return None
        assert isinstance(step, Frame)
        self._clock.now_ns += PERIOD_NS
        return replace(step, t_ns=self._clock.now_ns + step.t_ns, received_ns=self._clock.now_ns)

    def close(self) -> None:
        self.closed += 1


class Keeper:
    """A sink that keeps what it gets, and at what time."""

    def __init__(self, clock: Clock, heard: Callable[[Event], None] = lambda _event: None) -> None:
        self.events: list[Event] = []
        self.times_ns: list[int] = []
        self.closed = 0
        self.polls = 0
        self._clock = clock
        self._heard = heard
        self.unwanted: Callable[[str], bool] = lambda topic: topic == "spectrum"

    def wants(self, topic: str) -> bool:
        return not self.unwanted(topic)

    def publish(self, event: Event, received_ns: int) -> None:
        assert not self.closed
        assert received_ns <= self._clock()
        self.events.append(event)
        self.times_ns.append(self._clock())
        self._heard(event)

    def poll(self) -> None:
        self.polls += 1

    def close(self) -> None:
        self.closed += 1

    @property
    def health(self) -> list[HealthEvent]:
        return [event for event in self.events if isinstance(event, HealthEvent)]

    def states(self) -> list[str]:
        """The states in order, each once."""
        states = [event.state for event in self.health]
        return [state for before, state in pairwise(["", *states]) if state != before]

    def phases(self) -> list[tuple[int, str]]:
        touches = [event for event in self.events if isinstance(event, TouchEvent)]
        return [(c.id, c.phase) for event in touches for c in event.contacts if c.phase in ("down", "up")]
