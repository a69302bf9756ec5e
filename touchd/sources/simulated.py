"""Frames live from the digital twin, computed ahead of time by a thread."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

from touchd.errors import SimulationError
from touchd.frame import Counts, Frame
from touchd.recording.data import Meta
from touchd.sources.source import EndOfStream, Source, touching
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.simulate import DEFAULT_PLATE, meta_of, stream

_AHEAD = 3
"""Blocks of frames that are computed ahead."""
_MAX_WAIT_S = 1e6
_LATE_NS = 100_000_000
"""A frame may come this much later than its time says, a fifth of a subscriber's `max_age_s`: then the clock counts."""


class _Block(NamedTuple):
    counts: Counts
    took_ns: int
    """To compute."""


class SimulatedSource(Source):
    """A scene as if it happened now. A slow reader gets every frame, late ones at once.

    A frame's `t_ns` is the clock at the first frame plus the scene's own time, so events do not depend on the speed of
    this computer. Only where it cannot keep up, frames are as far apart in time as they take to compute, and the scene
    goes slower: a subscriber drops events that are old. The first lap, of `frames` if given, is bit for bit what
    `simulate_scene` returns for the seed; later laps, if it is to loop, repeat the scene with other noise; sequence and
    time continue. Unless it is `paced`, frames come as soon as they are computed. At a lower rate (`set_rate`) the
    source leaves out the frames between.

    Raises SimulationError if the scene is unknown, too short, or does not fit the plate.
    """

    labelled = True

    def __init__(
        self,
        scene: str,
        *,
        seed: int = 0,
        frames: int | None = None,
        paced: bool = True,
        loop: bool = True,
        instrument: Instrument | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._stage = stage_scene(scene, instrument.plate if instrument else DEFAULT_PLATE, seed=seed, frames=frames)
        self._instrument = instrument or Instrument(DEFAULT_PLATE)
        self.acquisition = self._instrument.acquisition
        self.meta: Meta = meta_of(self._instrument, self._stage.rate_hz, self._stage.notes)
        self._seed, self._paced, self._loop = seed, paced, loop
        self._clock, self._sleep = clock, sleep
        self._complete_ns = round(self.acquisition.samples / self.acquisition.sample_rate_hz * 1e9)
        self._epoch_ns: int | None = None
        self._block: Counts | None = None
        self._next = 0  # in the block
        self._frame = 0  # in the lap
        self._lap = 0
        self._last_ns = 0
        self._awaited = False  # the next block was not computed when it was asked for
        self._behind_ns = 0.0  # the scene's time, behind the clock's since the first frame
        self._stretch_ns = 0.0  # what each frame of this block adds to it
        self._omitted = 0  # frames left out because of the rate: no number counts them
        self._period_ns, self._wanted_ns = 0.0, -math.inf  # of the rate asked for, and time of the next frame
        self._truth, _ = self._stage.truth()
        self._sequence: list[int] = self._stage.sequence.tolist()
        self._ended = False
        self._computed = self._compute()
        self._worker = ThreadPoolExecutor(1, "twin")
        self._blocks = deque(self._request() for _ in range(_AHEAD))

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame once it is due and computed; None if that takes longer than `timeout_s`.

        Raises EndOfStream after the last frame, unless the scene loops, and after `close`; SimulationError if the twin
        has failed.
        """
        if self._ended:
            raise EndOfStream
        now_ns = self._clock()
        deadline_ns = now_ns + round(min(max(timeout_s, 0.0), _MAX_WAIT_S) * 1e9)
        while True:
            if not self._take_block((deadline_ns - now_ns) / 1e9):
                return None
            assert self._block is not None
            sequence, t_ns = self._stamp()
            now_ns = self._clock()
            if t_ns >= self._wanted_ns - 0.5e9 / self._stage.rate_hz:
                break
            self._advance()
            self._omitted += 1
        if self._paced:
            due_ns = t_ns + self._complete_ns
            while now_ns < min(due_ns, deadline_ns):
                self._sleep((min(due_ns, deadline_ns) - now_ns) / 1e9)
                now_ns = self._clock()
            if now_ns < due_ns:
                return None
        counts = self._block[self._next]
        self._advance()
        self._last_ns = t_ns
        if self._period_ns:
            self._wanted_ns = max(self._wanted_ns, t_ns - self._period_ns) + self._period_ns
        return Frame(counts, sequence - self._omitted, t_ns, now_ns)

    def set_rate(self, rate_hz: int) -> bool:
        """Return the frames nearest to this rate from now on, all from the scene's own rate on; never fails."""
        self._period_ns, self._wanted_ns = 0.0, -math.inf
        if rate_hz < self._stage.rate_hz:
            self._period_ns = 1e9 / rate_hz
            self._wanted_ns = self._last_ns + self._period_ns
        return True

    def truth(self) -> list[tuple[float, float]]:
        """Return the places of the fingers in the frame that was read last, mm."""
        return touching(self._truth, self._frame - 1)

    def close(self) -> None:
        """Stop computing; further calls do nothing."""
        self._ended = True
        self._worker.shutdown(cancel_futures=True)

    def _stamp(self) -> tuple[int, int]:
        """Return the number and the time of the next frame."""
        if self._epoch_ns is None:  # the first block has just been computed: its frames are on time
            self._epoch_ns = self._clock()
        laps_ahead = self._lap * (self._sequence[-1] + 1 - self._sequence[0])
        sequence = laps_ahead + self._sequence[self._frame]
        scene_ns = (sequence - self._sequence[0]) * 1e9 / self._stage.rate_hz
        return sequence, self._epoch_ns + round(scene_ns + self._behind_ns)

    def _advance(self) -> None:
        self._behind_ns += self._stretch_ns
        self._next += 1
        self._frame += 1
        if self._frame == len(self._sequence):
            self._frame, self._lap = 0, self._lap + 1

    def _take_block(self, timeout_s: float) -> bool:
        """Take the next block if the last one is used up; return False if none came in time."""
        if self._block is not None and self._next < len(self._block):
            return True
        self._awaited |= not self._blocks[0].done()
        try:
            block = self._blocks[0].result(max(timeout_s, 0.0))
        except TimeoutError:
            return False
        except Exception as error:
            self._ended = True
            if isinstance(error, SimulationError):
                raise
            raise SimulationError(f"the twin failed: {error!r}", "source") from error
        if block is None:
            self._ended = True
            raise EndOfStream
        self._block, self._next, self._stretch_ns = block.counts, 0, 0.0
        if self._paced and self._awaited:
            late_ns = self._clock() - self._stamp()[1] - self._complete_ns
            self._behind_ns += late_ns if late_ns > _LATE_NS else 0
            period_ns = 1e9 / self._stage.rate_hz
            if late_ns > -period_ns / 2:  # just in time, or late
                self._stretch_ns = max(block.took_ns / len(block.counts) - period_ns, 0.0)
        self._awaited = False
        self._blocks.popleft()
        self._blocks.append(self._request())
        return True

    def _request(self) -> Future[_Block | None]:
        """Have the thread compute the next block; None after the last one."""
        return self._worker.submit(lambda: next(self._computed, None))

    def _compute(self) -> Iterator[_Block]:
        """Compute the blocks of all laps."""
        lap = 0
        while lap == 0 or self._loop:
            seed = self._seed if lap == 0 else (self._seed, lap)
            began_ns = self._clock()
            for counts in stream(self._stage, self._instrument, seed):
                # Read-only, like the frames of every other source.
                counts.flags.writeable = False
                yield _Block(counts, self._clock() - began_ns)
                began_ns = self._clock()
            lap += 1
