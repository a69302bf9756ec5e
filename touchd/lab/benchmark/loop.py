"""Play frames to and fro without a seam, for any duration."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, cycle

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Acquisition, Counts, Frame
from touchd.sources.source import EndOfStream

PERIOD_NS = 8_000_000
"""Frame period in the frames' own time at full speed, as at 125 frames/s."""
BURST_EVERY, BURST = 250, 10
"""At full speed, `BURST` bare runs follow every `BURST_EVERY` frames."""


@dataclass(frozen=True, slots=True)
class Loop:
    """A scene to play: a lead-in once, then the rest to and fro."""

    acquisition: Acquisition
    frames: NDArray[np.int16]
    """Shape (n, channels, samples)."""
    lead: int
    """Number of lead-in frames."""

    def counts(self) -> Iterator[Counts]:
        """Yield the lead-in, then the rest to and fro without end."""
        lead, there = list(self.frames[: self.lead]), list(self.frames[self.lead :])
        return chain(lead, cycle([*there, *there[-2:0:-1]]))


class LoopSource:
    """A source that delivers the frames of a loop when due; the lead-in comes at once.

    An infinite `rate_hz` is full speed; `seconds` count after the lead-in. `between` is called every `BURST_EVERY`
    frames at full speed, and its time is excluded; `begun` is called before the first frame after the lead-in.
    """

    def __init__(
        self, loop: Loop, rate_hz: float, seconds: float, between: Callable[[], object] = lambda: None,
        begun: Callable[[], object] = lambda: None,
    ) -> None:  # fmt: skip
        self.acquisition = loop.acquisition
        self.lead = loop.lead
        self._paced = rate_hz != float("inf")
        self._period_ns = round(1e9 / rate_hz) if self._paced else PERIOD_NS
        self._seconds = seconds
        self._between, self._begun = between, begun
        self._counts = loop.counts()
        self._number = 0
        self._start_ns = self._end_ns = 0
        self._next_burst = 0
        self._open = True
        self.apart_ns = 0
        """Time spent in `between`."""

    def read(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 - the next frame is due before any timeout
        """Return the next frame when it is due.

        Raises
        ------
        EndOfStream
            The duration is over.
        """
        number, now_ns = self._number, time.monotonic_ns()
        if not self._open:
            raise EndOfStream
        if number in (0, self.lead):
            if number == self.lead:
                self._begun()
                now_ns = time.monotonic_ns()
                self._end_ns = now_ns + round(self._seconds * 1e9)
                self._next_burst = number  # so that a run of few frames has one, too
            self._start_ns = now_ns - max(number, self.lead) * self._period_ns
        if number >= self.lead:
            if now_ns >= self._end_ns:
                raise EndOfStream
            if self._paced:
                due_ns = self._start_ns + number * self._period_ns
                while now_ns < due_ns:
                    time.sleep((due_ns - now_ns) * 1e-9)
                    now_ns = time.monotonic_ns()
            elif number >= self._next_burst:
                self._next_burst = number + BURST_EVERY
                self._between()
                now_ns, before_ns = time.monotonic_ns(), now_ns
                self.apart_ns += now_ns - before_ns
        self._number = number + 1
        return Frame(next(self._counts), number, self._start_ns + number * self._period_ns, now_ns)

    def close(self) -> None:
        """End the stream."""
        self._open = False
