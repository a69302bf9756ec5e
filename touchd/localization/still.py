"""Has anything changed since the network looked last? If not, what it said then still holds."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np

from touchd.detection.baseline import Signal
from touchd.detection.gate import Gate


class Still:
    """Tells a frame that differs by no more than noise from the one that was looked at last.

    What is compared is always that frame, not the one before: a finger that creeps is seen as soon as it has come
    farther than the noise explains. Two frames of the same plate differ by twice the noise's energy, and otherwise as
    one untouched frame differs from the baseline, whose distribution the gate knows.

    Parameters
    ----------
    shape : tuple of int
        Of a frame, (channels, samples).
    false_alarm_rate : float
        Probability that a frame of a plate on which nothing has changed is taken for a changed one: for white noise;
        up to four times as much where two thirds of the noise are of one shape, as trigger jitter is.
    """

    def __init__(self, shape: tuple[int, int], false_alarm_rate: float) -> None:
        self._seen = np.zeros(shape, np.float32)
        self._difference = np.zeros(shape, np.float32)
        self._flat = self._difference.reshape(-1)
        self._energy = np.zeros((), np.float32)
        self._subtract = np.subtract
        self.retune(false_alarm_rate)
        self.forget()

    def retune(self, false_alarm_rate: float) -> None:
        """Take another rate, from the next frame that is looked at on."""
        self._quantile = NormalDist().inv_cdf(1.0 - false_alarm_rate)

    def forget(self) -> None:
        """Have the next frame looked at, whatever it holds."""
        self._most = -math.inf

    def look(self, residual: Signal, gate: Gate) -> None:
        """Keep a frame's residual, shape (channels, samples): this one is being looked at."""
        self._seen[...] = residual
        self._most = 2.0 * gate.energy_above(self._quantile)

    def holds(self, residual: Signal) -> bool:
        """Return whether a frame's residual is, but for the noise, that of the one looked at last."""
        if self._most < 0.0:
            return False
        self._subtract(residual, self._seen, self._difference)
        self._flat.dot(self._flat, self._energy)
        # Asked this way round, so that NaN is looked at.
        return self._energy.item() <= self._most
