"""Find a DAQ that hangs: two equal frames cannot both be measurements, because noise never repeats."""

from __future__ import annotations

from collections import deque
from itertools import cycle

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.frame import Counts

LASTING_FRAMES = 3
"""Three equal frames in a row are no coincidence, even where the noise is a hundredth of a count: some of a channel's
samples change from frame to frame."""
LONGEST_CYCLE = 8
"""Frames that come again in a cycle are found if it is no longer than this."""

_Samples = NDArray[np.floating] | Counts


class Stuck:
    """Compares each frame with its predecessor, and with one that is kept for a while, bit for bit.

    In a cycle the kept frame comes again and again (R. Brent, BIT 20:176, 1980). One sample of most frames is compared,
    which is seldom equal twice; then five more of its channel, which never are. Only then are all samples compared.
    While a finger is down the baseline is frozen, and the residual's energy is a digest of the whole frame: each frame
    of a cycle has the energy of one of the last eight, to the bit.

    Parameters
    ----------
    shape : tuple of int
        Of a frame, (channels, samples).
    dtype : type
        Of the signal.
    """

    def __init__(self, shape: tuple[int, int], dtype: DTypeLike = np.float32) -> None:
        channels, samples = shape
        self._steps = [step * samples // 8 for step in range(1, 6)]
        self._next = cycle([channel * samples + samples // 4 for channel in range(channels)]).__next__
        self._at = self._next()
        self._sample: float | None = None  # of the predecessor
        self._kept: NDArray[np.floating] = np.full(shape, np.nan, dtype)
        self._kept_sample: float | None = None
        self._age = 0  # frames since the kept one came again, while `doubtful`
        self._cycle = 0  # frames between its last two returns
        self._energies: deque[float] = deque(maxlen=LONGEST_CYCLE)  # of touched frames, the newest first
        self._returned = 0  # frames since the last touched one had come before; 0 if it had not
        self._closely = False  # whether more than one sample of the next frame is compared
        self._same = np.zeros(shape, bool)
        self._repeats = np.zeros(channels, np.int64)
        self._suspect = False  # whether any channel was equal last time
        self.doubtful = False
        """Whether a frame has come again lately: it may have been sent late, or begin a cycle."""
        self.period = 0
        """Length of the cycle in which frames come again; 0 without one."""
        self.live: NDArray[np.bool_] = np.ones(channels, bool)
        """Channels that are not stuck, or all are. Replaced, never written to, when it changes."""

    def turn(self, frame: _Samples) -> None:
        """Watch the next channel after this frame: a channel that is stuck alone is found while it is watched."""
        at = self._at = self._next()
        self._sample, self._kept_sample = frame.item(at), self._kept.item(at)

    def repeats(self, counts: Counts, previous: NDArray[np.floating]) -> bool:
        """Return whether a frame equals the previous one, or comes again in a cycle; shapes (channels, samples)."""
        sample, before = counts.item(self._at), self._sample
        self._sample = sample
        if sample != before and sample != self._kept_sample and not self._closely:
            return False
        equal = self._suspect or (sample == before and self._is_alike(counts, previous))
        equal = equal and self._compare(counts, previous)
        self._returned = 0
        self._follow_cycle(counts, returned=sample == self._kept_sample and self._is_alike(counts, self._kept))
        self._closely = self._suspect or self.doubtful
        return self.period > 0 or equal

    def returns(self, energy: float) -> bool:
        """Take the energy of a touched frame's residual; return whether one of the last eight had the same."""
        energies = self._energies
        self._returned = energies.index(energy) + 1 if energy in energies else 0
        energies.appendleft(energy)
        return self._returned > 0

    def keep(self, frame: NDArray[np.floating]) -> None:
        """Keep this frame to compare later ones with, and watch the next channel."""
        if not self.doubtful:
            self._kept[...] = frame
        self.turn(frame)

    def _follow_cycle(self, counts: Counts, *, returned: bool) -> None:
        """Count the frames from one return of the kept frame to the next; twice the same number is a cycle."""
        self._age += 1
        if returned and bool((counts == self._kept).all()):
            self.period = self._age if self._age == self._cycle else 0
            self._cycle = self._age if self.doubtful else 0
            self.doubtful, self._age = True, 0
        elif self._age >= (self.period or LONGEST_CYCLE):
            self.doubtful, self.period, self._cycle = False, 0, 0

    @property
    def fault(self) -> str:
        """What is wrong with a frame that repeats an earlier one, for a person."""
        length = self.period or self._returned or self._cycle
        return f"the DAQ repeats its last {length} frames" if length > 1 else "the DAQ repeats one frame"

    def _is_alike(self, counts: Counts, other: _Samples) -> bool:
        """Return whether five more samples of the watched channel are equal."""
        at, item, other_item = self._at, counts.item, other.item
        for step in self._steps:  # noqa: SIM110 - runs for every fourth frame: `all` takes twice as long
            if item(at + step) != other_item(at + step):
                return False
        return True

    def _compare(self, counts: Counts, previous: NDArray[np.floating]) -> bool:
        """Compare all samples with the predecessor's."""
        np.equal(counts, previous, out=self._same)
        same = self._same.all(axis=1)
        self._suspect = bool(same.any())
        if same.all():
            return True
        self._repeats = np.where(same, self._repeats + 1, 0)
        live = self._repeats < LASTING_FRAMES
        if (live != self.live).any():
            self.live = live
        return False
