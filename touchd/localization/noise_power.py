"""What the bins hold while nothing touches the plate: how much noise there is, and which bins drown in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Array

MEMORY_FRAMES = 256
DROWNED = 10.0
"""A bin with so many times the noise of most others holds a tone from elsewhere: it is left out."""
_LEAST_FRAMES = 16


class Noise:
    """The mean power of each feature over untouched frames.

    White noise would be known from the samples, but tones and trigger jitter have a spectrum of their own.

    Parameters
    ----------
    channels, bins : int
    """

    def __init__(self, channels: int, bins: int) -> None:
        self._shape = channels, 2, bins
        self._heard = 0
        self.power: Array = np.zeros(channels * 2 * bins, np.float32)
        """Of each feature, counts squared."""
        self._square = np.zeros_like(self.power)
        self._weight = np.zeros((), np.float32)

    def forget(self) -> None:
        """Begin anew with the next frame."""
        self.begin()
        self.power[:] = 0

    def begin(self) -> None:
        """Let the frames to come count alone; until the next one, what was heard holds."""
        self._heard = 0

    def hear(self, features: Array) -> bool:
        """Take in the features of an untouched frame's residual, shape (channels * 2 * bins,).

        Returns whether it was the one that makes them enough to tell which bins drown.
        """
        self._heard = min(self._heard + 1, MEMORY_FRAMES)
        np.multiply(features, features, out=self._square)
        np.subtract(self._square, self.power, out=self._square)
        self._weight[...] = 1 / self._heard
        np.multiply(self._square, self._weight, out=self._square)
        np.add(self.power, self._square, out=self.power)
        return self._heard == _LEAST_FRAMES

    def quiet(self) -> NDArray[np.bool_]:
        """Return which features tell more than noise, shape (channels * 2 * bins,): all while little was heard."""
        of_bins = self.power.reshape(self._shape).sum(axis=1, keepdims=True)
        usual = float(np.median(of_bins))
        if self._heard < _LEAST_FRAMES or usual <= 0:
            return np.ones(self.power.shape, bool)
        return np.repeat(of_bins < DROWNED * usual, 2, axis=1).reshape(-1)
