"""Play a recording back as if it happened now."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from touchd.errors import ConfigError
from touchd.frame import Counts, Frame
from touchd.recording.data import MAX_COUNT, Meta, Recording
from touchd.recording.format import Reader
from touchd.sources.source import EndOfStream, Source, touching

MIN_SPEED = 0.001
_MAX_WAIT_S = 1e6


class ReplaySource(Source):
    """Frames of a recording, at the pace of their timestamps. A slow reader gets every frame, late ones at once.

    A frame's `t_ns` is the clock at the first frame plus the recorded time since then, at every `speed`: 2 takes half
    as long as the recording, infinity never waits. If it is to loop, sequence and time continue, with one frame period
    between the laps. The counts are read-only views of the recording in memory; of a folder one chunk is in memory at a
    time.

    Raises RecordingError if the recording cannot be used; `read` raises it for a later chunk of a folder. Raises
    ConfigError for a speed below 0.001.
    """

    labelled = True

    def __init__(
        self,
        path: Path,
        speed: float = 1.0,
        loop: bool = False,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not speed >= MIN_SPEED:  # NaN too
            raise ConfigError(f"must be {MIN_SPEED} or more, is {speed:g}", "replay speed", "give a factor, or max")
        self._reader = Reader(path)
        self.meta: Meta = self._reader.meta
        self.acquisition = self._reader.acquisition
        self._speed = speed
        self._paced = math.isfinite(speed)
        self._loop = loop
        self._clock = clock
        self._sleep = sleep
        self._epoch_ns: int | None = None
        # Added to the recording's own counters; they grow from lap to lap.
        self._sequence_shift = 0
        self._time_shift_ns = 0
        # The chunk being played, and the next frame in it.
        self._sequence: list[int] = []
        self._elapsed_ns: list[int] = []
        self._next = 0
        self._chunks: Iterator[Recording] = iter(self._reader)
        first = next(self._chunks)
        self._first_sequence = int(first.sequence[0])
        self._first_ns = int(first.timestamp_ns[0])
        self._take(first)

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame once it is due; None if it is not due within `timeout_s`.

        Raises EndOfStream after the last frame, unless the replay loops; before numbers or times overflow; after
        `close`.
        """
        i = self._next
        if i == len(self._sequence):
            self._advance()
            i = 0
        now_ns = self._clock()
        if self._epoch_ns is None:
            self._epoch_ns = now_ns
        elapsed_ns = self._elapsed_ns[i]
        if self._paced:
            due_ns = self._epoch_ns + round(elapsed_ns / self._speed)
            if now_ns < due_ns:
                timeout_ns = round(min(max(timeout_s, 0.0), _MAX_WAIT_S) * 1e9)
                now_ns = self._wait_until(min(due_ns, now_ns + timeout_ns), now_ns)
                if now_ns < due_ns:
                    return None
        self._next = i + 1
        return Frame(self._counts[i], self._sequence[i], self._epoch_ns + elapsed_ns, now_ns)

    def truth(self) -> list[tuple[float, float]]:
        """Return the places of the fingers in the frame that was read last, mm; none of a recording without labels."""
        return touching(self._contacts_mm, self._next - 1)

    def close(self) -> None:
        """Release the recording."""
        self._loop = False
        self._chunks = iter(())
        self._sequence, self._elapsed_ns = [], []
        self._next = 0

    def _wait_until(self, until_ns: int, now_ns: int) -> int:
        while now_ns < until_ns:
            self._sleep((until_ns - now_ns) / 1e9)
            now_ns = self._clock()
        return now_ns

    def _advance(self) -> None:
        """Take the next chunk, or the first one of another lap."""
        chunk = next(self._chunks, None)
        if chunk is not None:
            self._take(chunk)
        elif self._loop and max(self._sequence[-1], self._elapsed_ns[-1]) < MAX_COUNT // 4:  # the next lap has room
            self._sequence_shift = self._sequence[-1] + 1 - self._first_sequence
            self._time_shift_ns = self._elapsed_ns[-1] + self._period_ns()
            self._chunks = iter(self._reader)
            self._take(next(self._chunks))
        else:
            raise EndOfStream

    def _take(self, chunk: Recording) -> None:
        self._counts: Counts = chunk.frames.view()
        self._contacts_mm = chunk.contacts_mm
        # Read-only: a stage that wrote into a frame would change the next lap.
        self._counts.flags.writeable = False
        # Python's integers index faster, and no number of laps overflows them.
        shift, shift_ns = self._sequence_shift, self._time_shift_ns - self._first_ns
        self._sequence = [shift + n for n in chunk.sequence.tolist()]
        self._elapsed_ns = [shift_ns + t for t in chunk.timestamp_ns.tolist()]
        self._next = 0

    def _period_ns(self) -> int:
        return max(1, round(min(1e9 / self.meta.frame_rate_hz, _MAX_WAIT_S * 1e9)))
