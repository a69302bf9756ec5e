"""Is anything there? A threshold on the residual's energy that follows the noise."""

from __future__ import annotations

import math
from collections import deque
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import GateSettings

_CHANGED_FRAMES, _LEARN_FRAMES = 48, 32
"""Noise is another when so many frames in a row hold less than its mean, or more: by chance once in 2^47. The first of
them may have seen it change: so many of the last are learned from."""
_SET_EVERY = 128
"""Thresholds are set anew after one in so many of the frames that the noise is known from: few change it little."""
_CHANGED = 1.25
"""A change of its energy by this factor is worth telling."""


class Gate:
    """Open while the residual holds more energy than the noise explains, closed otherwise.

    The cube root of an energy (a sum of squares) is very nearly normal, whatever its degrees of
    freedom (Wilson and Hilferty, PNAS 17:684, 1931). So the mean and the deviation of that root over
    untouched frames give the threshold for a stated false-alarm rate a frame, for white noise and for
    coloured noise (trigger jitter, interference) alike.
    """

    def __init__(self, settings: GateSettings) -> None:
        self._count, self._weight, self._margin = 0, 1.0, 1.0
        self._mean = 0.0
        self._variance = 0.0
        self._deviation = 0.0
        self._open_above = math.inf
        self._close_below = math.inf
        self._run, self._below, self._due = 0, False, 0
        self._told = 0.0
        self._last: deque[float] = deque(maxlen=_LEARN_FRAMES)
        self.is_open = False
        self._set_parameters(settings)

    def retune(self, settings: GateSettings) -> None:
        """Take another false-alarm rate, hysteresis and memory; the noise stays as it is known."""
        self._set_parameters(settings)
        if self._count:
            self._set_thresholds()

    def learn(self, energies: NDArray[np.float64]) -> None:
        """Start afresh from the energies of untouched frames, shape (n,), n >= 2. Closes the gate."""
        roots = np.cbrt(energies)
        self._run = 0
        self._know(len(roots))
        self._mean = float(roots.mean())
        self._variance = float(roots.var(ddof=1))
        self._told = self.noise_energy
        self.is_open = False
        self._set_thresholds()

    def decide(self, energy: float) -> bool:
        """Return whether the gate is open for a frame whose residual holds this energy (counts squared)."""
        self.is_open = energy > (self._close_below if self.is_open else self._open_above)
        return self.is_open

    def follow(self, energy: float) -> bool:
        """Take in the energy of one more untouched frame, and return whether the noise has become another.

        If so it is learned anew: the beginning and the end of a tone from elsewhere would else count as the noise's
        deviation for as long as they are remembered, and keep the threshold above many a finger.
        """
        self._last.append(energy)
        step = energy ** (1 / 3) - self._mean
        below = step < 0
        self._run = self._run + 1 if below is self._below else 1
        self._below = below
        if self._run == _CHANGED_FRAMES:
            told = self._told
            self.learn(np.array(self._last))
            if not told / _CHANGED < self.noise_energy < told * _CHANGED:
                return True
            self._told = told
            return False
        if self._count != self._memory:
            self._know(min(self._count + 1, self._memory))
        weight = self._weight
        self._mean += weight * step
        # The exact update of an exponentially weighted variance (West, CACM 22:532, 1979).
        self._variance = (1.0 - weight) * (self._variance + weight * step * step)
        self._due -= 1
        if self._due <= 0:
            self._set_thresholds()
        return False

    @property
    def noise_energy(self) -> float:
        """The energy of the residual of an untouched frame, ADC counts squared."""
        return self._mean**3

    @property
    def threshold_energy(self) -> float:
        """The energy above which a closed gate opens, ADC counts squared."""
        return self._open_above

    def energy_above(self, quantile: float) -> float:
        """Return the energy of the residual which untouched frames exceed as a normal deviate exceeds the quantile."""
        return (self._mean + quantile * self._deviation) ** 3

    def _set_parameters(self, settings: GateSettings) -> None:
        self._quantile = NormalDist().inv_cdf(1.0 - settings.false_alarm_rate)
        self._close_ratio = settings.close_ratio
        self._memory = settings.noise_frames

    def _know(self, frames: int) -> None:
        """Take note that the noise is known from so many frames."""
        self._count = frames
        self._weight = 1.0 / frames
        # The deviation is known from few frames at first: its upper confidence limit keeps the stated rate.
        self._margin = 1.0 + 2.0 / math.sqrt(2.0 * frames)

    def _set_thresholds(self) -> None:
        self._due = self._count // _SET_EVERY
        mean = self._mean
        self._deviation = deviation = math.sqrt(self._variance) * self._margin
        excess = self._quantile * deviation
        opens, closes = mean + excess, mean + self._close_ratio * excess
        self._open_above = opens * opens * opens
        self._close_below = closes * closes * closes
