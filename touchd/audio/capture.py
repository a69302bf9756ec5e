"""What was captured and is not cut yet: samples are counted from the start on, and cut once a period."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.audio.card import Samples

_FRAMES = 4


class Capture:
    """The last periods of some inputs.

    Parameters
    ----------
    inputs : array of int
        Which of the captured inputs to hold.
    period : int
        Samples from chirp to chirp.
    chirps : int
        From cut to cut, of a frame.
    margin : int
        Samples before a cut that are needed, too.
    """

    def __init__(self, inputs: NDArray[np.int64], period: int, chirps: int, margin: int) -> None:
        self._inputs, self._period, self._chirps, self._margin = inputs, period, chirps, margin
        self._share = np.float32(1 / chirps)
        self._held = np.zeros((len(inputs), max(_FRAMES * chirps, 6) * period), np.int16)
        self.reset()

    def reset(self) -> None:
        """Count from 0: the capture starts again."""
        self._first = self._end = self._next = 0  # of the first sample held, behind the last one, of the next cut

    def skip(self, samples: int, *, whole_periods: bool) -> None:
        """Move the next cut; by whole periods it keeps its place in the period."""
        self._next += -(-samples // self._period) * self._period if whole_periods else samples

    def skip_frame(self) -> None:
        """Move the next cut behind a frame's chirps."""
        self._next += self._chirps * self._period

    def has(self, samples: int) -> bool:
        """Return whether so many samples from the next cut on are captured."""
        return self._end - self._next >= samples

    def append(self, block: Samples) -> None:
        """Take a block of shape (n, all inputs), and drop what no cut needs."""
        count = len(block)
        if self._end - self._first + count > self._held.shape[1]:
            first = max(min(self._next - self._margin, self._end), self._first)
            left = self._held[:, first - self._first : self._end - self._first].copy()
            if left.shape[1] + count > self._held.shape[1]:  # a longer block than was asked for
                self._held = np.zeros((len(left), left.shape[1] + count), np.int16)
            self._held[:, : left.shape[1]] = left
            self._first = first
        at = self._end - self._first
        self._held[:, at : at + count] = block.T[self._inputs]
        self._end += count

    def take(self) -> Samples:
        """Return the period from the next cut on, (inputs, period), a view; the cut moves behind it."""
        at = self._next - self._first
        self._next += self._period
        return self._held[:, at : at + self._period]

    def frame(self, samples: int) -> NDArray[np.generic]:
        """Return the mean of a frame's chirps, (inputs, margin + samples + margin); the cut moves behind them."""
        at, wide = self._next - self._first - self._margin, samples + 2 * self._margin
        self.skip_frame()
        if self._chirps == 1:
            return self._held[:, at : at + wide]
        row, each = self._held.strides
        shape, strides = (len(self._held), self._chirps, wide), (row, each * self._period, each)
        chirps: Samples = np.ndarray(shape, np.int16, self._held, each * at, strides)
        mean: NDArray[np.float32] = np.add.reduce(chirps, axis=1, dtype=np.float32)
        mean *= self._share
        return mean

    def needed(self, samples: int) -> int:
        """Return how many samples from the cut on a frame takes."""
        return (self._chirps - 1) * self._period + samples + self._margin
