"""Interfering tones that keep the gate open: few bins are loud for a second, and no finger explains them.

Noise is learned from untouched frames. A tone that begins while the daemon runs leaves none if its phase creeps or
repeats from frame to frame: it is neither noise nor drift nor part of the untouched plate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.localization.atlas import Array
from touchd.localization.noise import BinPower

WATCHED_NS = 1_000_000_000
"""Frames without a finger are averaged over this time."""
WATCH_EVERY = 4
"""One of 4 such frames is averaged."""
LOUD = 4.0
"""A bin is loud at 4 times the power of its noise: a tone of -30 dB is, in seven bins of a channel (twin)."""
MOST_LOUD, LEAST_SHARE = 0.5, 0.95
"""It is a tone if half of the bins at most are loud and hold 95 % of what is not noise. Fingers, palms and water are
loud in nearly all."""


class Tones:
    """Finds the bins that hold tones.

    Parameters
    ----------
    channels, bins : int
    dtype : type
    """

    def __init__(self, channels: int, bins: int, dtype: DTypeLike = np.float32) -> None:
        self._shape = channels, 2, bins
        self._heard = BinPower(channels, bins, dtype)
        self.quiet: NDArray[np.bool_] | None = None
        """Values without a tone, shape (channels * 2 * bins,), until `reset`; None if no tone is known."""
        self.reset()

    def reset(self) -> None:
        """Forget what was heard, and all tones."""
        self.quiet = None
        self.restart()

    def restart(self) -> None:
        """Listen from the next frame on: a finger was there."""
        self._since_ns: int | None = None

    def update(self, vector: Array, noise_power: Array, t_ns: int) -> bool:
        """Take the bins of a touched frame without a finger; return whether `quiet` has changed.

        Parameters
        ----------
        vector : array of shape (channels * 2 * bins,)
        noise_power : array of the same shape
            Of untouched frames, counts squared.
        t_ns : int
        """
        if self._since_ns is None or t_ns < self._since_ns:
            self._since_ns = t_ns
            self._heard.reset()
        self._heard.update(vector)
        if t_ns - self._since_ns < WATCHED_NS:
            return False
        self._since_ns = None
        heard, noise = (power.reshape(self._shape).sum(axis=1) for power in (self._heard.power, noise_power))
        loud, excess = heard > LOUD * noise, np.maximum(heard - noise, 0)
        if not (0 < loud.mean() <= MOST_LOUD and excess[loud].sum() >= LEAST_SHARE * excess.sum()):
            return False
        before, self.quiet = self.quiet, np.repeat(~loud[:, None], 2, axis=1).reshape(-1)
        return before is None or not np.array_equal(before, self.quiet)
