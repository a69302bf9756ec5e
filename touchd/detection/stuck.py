"""Is this a measurement? A DAQ that hangs repeats what it has sent: all of a frame, or what one channel heard."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from touchd.detection.baseline import Signal
from touchd.frame import Counts

LASTING_FRAMES = 3
"""Repeated so often in a row, to the bit, it is no coincidence: even where the noise is a hundredth of a count, some of
a channel's samples change from frame to frame."""

Channels = NDArray[np.bool_]


class Frozen:
    """Tells counts that are those of the frame before.

    Of most frames one sample is looked at, which seldom is the same twice; then five more, which never are. Only then
    are all compared.

    Parameters
    ----------
    seen : array of shape (channels, samples)
        The counts of the frame before, as floats: they are read here, and written by whoever takes frames in.
    tell : callable
        Told which channels are frozen, shape (channels,), when others are than before.
    """

    def __init__(self, seen: Signal, tell: Callable[[Channels], None]) -> None:
        channels, samples = seen.shape
        self._seen, self._tell = seen, tell
        self._flat = memoryview(seen.reshape(-1))  # type: ignore[arg-type]  # NumPy declares no buffer before 3.12
        self._others = [step * samples // 8 for step in range(1, 6)]
        self._next = cycle([channel * samples + samples // 4 for channel in range(channels)]).__next__
        self._same = np.zeros(seen.shape, bool)
        self._repeats = np.zeros(channels, np.int64)
        self._suspect = False  # whether anything was the same last time
        self.frames = 0
        """Frames in a row, this one the last, that were the same as the one before."""
        self.channels: Channels = np.zeros(channels, bool)
        """Which of them are frozen, while others are not."""
        self.turn()

    def turn(self) -> None:
        """Look at the next channel from now on: what freezes alone is found when it is looked at."""
        self._at = self._next()
        self._sample = self._flat[self._at]

    def repeats(self, counts: Counts) -> bool:
        """Return whether a frame, shape (channels, samples), is the one before; it must not have been taken in yet."""
        sample = counts.item(self._at)
        if sample != self._sample and not self._suspect:
            self._sample = sample
            return False
        self._sample = sample
        return (self._suspect or self._is_same_elsewhere(counts)) and self._compare(counts)

    def _is_same_elsewhere(self, counts: Counts) -> bool:
        """Return whether further samples of the channel are those of the frame before."""
        return all(counts.item(self._at + other) == self._flat[self._at + other] for other in self._others)

    def _compare(self, counts: Counts) -> bool:
        """Compare all samples."""
        np.equal(counts, self._seen, out=self._same)
        same = self._same.all(axis=1)
        self._suspect = bool(same.any())
        if same.all():
            self.frames += 1
            return True
        self.frames = 0
        self._repeats = np.where(same, self._repeats + 1, 0)
        frozen = self._repeats >= LASTING_FRAMES
        if (frozen != self.channels).any():
            self.channels = frozen
            self._tell(frozen)
        return False
