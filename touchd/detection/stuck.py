"""Find a DAQ that hangs: two equal frames cannot both be measurements, because noise never repeats."""

from __future__ import annotations

from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Counts

LASTING_FRAMES = 3
"""Three equal frames in a row are no coincidence, even where the noise is a hundredth of a count: some of a channel's
samples change from frame to frame."""

Channels = NDArray[np.bool_]


class Stuck:
    """Compares each frame with its predecessor, bit for bit.

    One sample of most frames is compared, which is seldom equal twice; then five more of its channel, which never are.
    Only then are all samples compared.

    Parameters
    ----------
    shape : tuple of int
        Of a frame, (channels, samples).
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        channels, samples = shape
        self._others = [step * samples // 8 for step in range(1, 6)]
        self._next = cycle([channel * samples + samples // 4 for channel in range(channels)]).__next__
        self._at = self._next()
        self._sample: float | None = None  # of the predecessor; None after a turn
        self._same = np.zeros(shape, bool)
        self._repeats = np.zeros(channels, np.int64)
        self._suspect = False  # whether any channel was equal last time
        self.frames = 0
        """Frames in a row, the last one included, that equalled their predecessor."""
        self.channels: Channels = np.zeros(channels, bool)
        """Channels that are stuck while others are not. Replaced, never written to, when it changes."""

    def turn(self) -> None:
        """Watch the next channel: a channel that is stuck alone is found while it is watched."""
        self._at = self._next()
        self._sample = None

    def repeats(self, counts: Counts, previous: NDArray[np.floating]) -> bool:
        """Return whether a frame equals the previous one; both of shape (channels, samples)."""
        sample = counts.item(self._at)
        before = previous.item(self._at) if self._sample is None else self._sample
        self._sample = sample
        if sample != before and not self._suspect:
            return False
        return (self._suspect or self._is_same_elsewhere(counts, previous)) and self._compare(counts, previous)

    def _is_same_elsewhere(self, counts: Counts, previous: NDArray[np.floating]) -> bool:
        return all(counts.item(self._at + other) == previous.item(self._at + other) for other in self._others)

    def _compare(self, counts: Counts, previous: NDArray[np.floating]) -> bool:
        """Compare all samples."""
        np.equal(counts, previous, out=self._same)
        same = self._same.all(axis=1)
        self._suspect = bool(same.any())
        if same.all():
            self.frames += 1
            return True
        self.frames = 0
        self._repeats = np.where(same, self._repeats + 1, 0)
        stuck = self._repeats >= LASTING_FRAMES
        if (stuck != self.channels).any():
            self.channels = stuck
        return False
