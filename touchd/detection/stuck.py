"""Find a DAQ that hangs: two equal frames cannot both be measurements, because noise never repeats."""

from __future__ import annotations

from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Counts

LASTING_FRAMES = 3
"""Three equal frames in a row are no coincidence, even where the noise is a hundredth of a count: some of a channel's
samples change from frame to frame."""
LONGEST_CYCLE = 8
"""Frames that come again in a cycle are found if it is no longer than this."""

Channels = NDArray[np.bool_]
_Samples = NDArray[np.floating] | Counts


class Stuck:
    """Compares each frame with its predecessor, and with one that is kept for 8 frames, bit for bit.

    In a cycle of up to 8 frames the kept one comes again and again (R. Brent, BIT 20:176, 1980). One sample of most
    frames is compared, which is seldom equal twice; then five more of its channel, which never are. Only then are all
    samples compared.

    Parameters
    ----------
    shape : tuple of int
        Of a frame, (channels, samples).
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        channels, samples = shape
        self._steps = [step * samples // 8 for step in range(1, 6)]
        self._next = cycle([channel * samples + samples // 4 for channel in range(channels)]).__next__
        self._at = self._next()
        self._sample: float | None = None  # of the predecessor
        self._kept: Counts = np.zeros(shape, np.int16)
        self._kept_sample: float | None = None
        self._age = LONGEST_CYCLE  # of the kept frame
        self._compare_from = 0  # the age from which all samples are compared
        self._cycle = 0  # frames after which the kept one came again, 0 if it did not
        self._returns = 0  # how often it did so in a row
        self._same = np.zeros(shape, bool)
        self._repeats = np.zeros(channels, np.int64)
        self._suspect = False  # whether any channel was equal last time
        self.doubtful = False
        """Whether a frame has come again lately: it may have been sent late, or begin a cycle."""
        self.period = 0
        """Frames after which the last one came again, 1 if it equalled its predecessor; 0 if it did not."""
        self.channels: Channels = np.zeros(channels, bool)
        """Channels that are stuck while others are not. Replaced, never written to, when it changes."""

    def turn(self, frame: _Samples) -> None:
        """Watch the next channel after this frame, to find one that is stuck alone; done for every 8th frame anyway."""
        at = self._at = self._next()
        self._sample, self._kept_sample = frame.item(at), self._kept.item(at)

    def repeats(self, counts: Counts, previous: NDArray[np.floating]) -> bool:
        """Return whether a frame equals the previous one, or comes again in a cycle; shapes (channels, samples)."""
        sample, before = counts.item(self._at), self._sample
        self._sample = sample
        self._age += 1
        if sample != before and self._age < self._compare_from and sample != self._kept_sample:
            return False
        equal = self._suspect or (sample == before and self._is_alike(counts, previous))
        equal = equal and self._compare(counts, previous)
        if sample == self._kept_sample and self._is_alike(counts, self._kept) and np.array_equal(counts, self._kept):
            self._returns = self._returns + 1 if self._age == self._cycle else 1
            self._cycle, self._age = self._age, 0
        elif self._age >= (self._cycle or LONGEST_CYCLE):  # no cycle brings the kept frame again
            self._kept[...] = counts
            self._cycle = self._returns = self._age = 0
            self._at = self._next()
            self._sample = self._kept_sample = counts.item(self._at)
        self.doubtful = self._cycle > 0
        self._compare_from = 0 if self._suspect or self._returns > 1 else self._cycle or LONGEST_CYCLE
        self.period = self._cycle if self._returns > 1 else int(equal)
        return self.period > 0

    @property
    def fault(self) -> str:
        """What is wrong with a frame that repeats an earlier one, for a person."""
        return "the DAQ repeats one frame" if self.period == 1 else f"the DAQ repeats its last {self.period} frames"

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
        stuck = self._repeats >= LASTING_FRAMES
        if (stuck != self.channels).any():
            self.channels = stuck
        return False
