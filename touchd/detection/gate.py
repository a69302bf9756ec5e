"""Is anything there? A threshold on the residual's energy that follows the noise."""

from __future__ import annotations

import math
from collections import deque
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import GateSettings
from touchd.detection.pace import USUAL_NS

_CHANGED_FRAMES, _LEARN_FRAMES = 48, 32
"""The noise level has stepped if 48 frames in a row hold less than its mean, or more: by chance once in 2^47. The gate
relearns it from the last 32 of them, since the first may have seen it change. Evidence counts frames, at any rate."""
_QUIET_FRAMES, _QUIET_SHARE = 12, 0.25
"""If 12 frames in a row hold less than noise ever does, and less than this share of its mean, a loud tone has ended:
the gate relearns the noise from them."""
_SET_SHARE = 128
"""The gate sets its thresholds after every 128th part of the frames that the noise is known from."""
_CLOSE_RATIO = 0.5
"""Hysteresis: the gate closes at this share of the excess that opens it."""
_FEWEST_FRAMES, _MOST_ALARMS = 10, 0.1
"""Limits of memory and rate, at every frame rate: those of the settings."""
_CHANGED = 1.25
"""`update` reports a step of the noise energy by this factor or more."""


class Gate:
    """Opens while the residual holds more energy than the noise explains.

    The cube root of an energy (a sum of squares) is very nearly normal, for any degrees of
    freedom (Wilson and Hilferty, PNAS 17:684, 1931). So the mean and the deviation of that root over
    untouched frames give the threshold for a stated false-alarm rate a frame, for white noise and for
    coloured noise (trigger jitter, interference) alike. Rate and memory are those of 125 frames a second; at another
    rate of frames both hold for the same time.
    """

    def __init__(self, settings: GateSettings, set_share: int = _SET_SHARE) -> None:
        self._set_share = set_share
        self._count, self._weight, self._margin = 0, 1.0, 1.0
        self.noise_root = 0.0
        """Mean cube root of the residual energy of untouched frames."""
        self._variance = 0.0
        self.noise_deviation = 0.0
        """Its standard deviation, with a margin for what few frames tell of it."""
        self.threshold_energy = math.inf
        """The energy above which a closed gate opens, ADC counts squared."""
        self._close_below = math.inf
        self._quiet_below, self._quiet = 0.0, 0
        self._run, self._below, self._due = 0, False, 0
        self._reported_energy = 0.0
        self._last: deque[float] = deque(maxlen=_LEARN_FRAMES)
        self.is_open = self._was_open = False
        self._periods = 1.0
        self.configure(settings)

    def set_period(self, period_ns: int) -> None:
        """Take the time from frame to frame: alarms stay as rare per time, and the memory as long."""
        self._periods = period_ns / USUAL_NS
        self.configure(self._settings)

    def configure(self, settings: GateSettings) -> None:
        """Take another false-alarm rate and memory; the noise estimate stays."""
        self._settings = settings
        self._quantile = -NormalDist().inv_cdf(min(settings.false_alarm_rate * self._periods, _MOST_ALARMS))
        self._memory = max(_FEWEST_FRAMES, round(settings.noise_frames / self._periods))
        if self._count:
            self._set_thresholds()

    def learn(self, energies: NDArray[np.float64]) -> None:
        """Estimate the noise from the energies of untouched frames, shape (n,), n >= 2, and close the gate."""
        roots = np.cbrt(energies)
        self._run = self._quiet = 0
        self._know(len(roots))
        self.noise_root = float(roots.mean())
        self._variance = float(roots.var(ddof=1))
        self._reported_energy = self.noise_energy
        self.is_open = False
        self._set_thresholds()

    def decide(self, energy: float) -> bool:
        """Return whether the gate is open for a frame whose residual holds this energy (counts squared)."""
        self._was_open = self.is_open
        self.is_open = energy > (self._close_below if self.is_open else self.threshold_energy)
        return self.is_open

    def decide_again(self, energy: float) -> bool:
        """Return the same of a frame that has been decided, but from which something was taken out."""
        self.is_open = self._was_open
        return self.decide(energy)

    def is_too_quiet(self, energy: float) -> bool:
        """Return whether noise holds less than this energy (counts squared) as seldom as it opens the gate."""
        return energy < self._quiet_below

    def update(self, energy: float) -> bool:
        """Add the energy of an untouched frame to the noise estimate, and return whether the noise level has stepped.

        After a step the gate relearns the noise. Otherwise the start and the end of an interfering tone would count as
        deviation of the noise for the length of the gate's memory, and keep the threshold above many fingers.
        """
        self._last.append(energy)
        step = energy ** (1 / 3) - self.noise_root
        below = step < 0
        self._run = self._run + 1 if below is self._below else 1
        self._below = below
        quiet = energy < self._quiet_below
        self._quiet = self._quiet + 1 if quiet and energy < _QUIET_SHARE * self.noise_energy else 0
        if self._run == _CHANGED_FRAMES or self._quiet == _QUIET_FRAMES:
            reported = self._reported_energy
            self.learn(np.array(self._last)[-_QUIET_FRAMES if self._quiet == _QUIET_FRAMES else 0 :])
            if not reported / _CHANGED < self.noise_energy < reported * _CHANGED:
                return True
            self._reported_energy = reported
            return False
        if quiet:
            return False  # it would count as deviation of a noise that has ended
        if self._count != self._memory:
            self._know(min(self._count + 1, self._memory))
        weight = self._weight
        self.noise_root += weight * step
        # The exact update of an exponentially weighted variance (West, CACM 22:532, 1979).
        self._variance = (1.0 - weight) * (self._variance + weight * step * step)
        self._due -= 1
        if self._due <= 0:
            self._set_thresholds()
        return False

    @property
    def noise_energy(self) -> float:
        """Mean energy of the residual of an untouched frame, ADC counts squared."""
        return self.noise_root**3

    def _know(self, frames: int) -> None:
        """Set the weight and the margin of an estimate from this many frames."""
        self._count = frames
        self._weight = 1.0 / frames
        # The deviation is known from few frames at first: its upper confidence limit keeps the stated rate.
        self._margin = 1.0 + 2.0 / math.sqrt(2.0 * frames)

    def _set_thresholds(self) -> None:
        self._due = self._count // self._set_share
        mean = self.noise_root
        self.noise_deviation = deviation = math.sqrt(self._variance) * self._margin
        excess = self._quantile * deviation
        opens, closes, quiet = mean + excess, mean + _CLOSE_RATIO * excess, max(mean - excess, 0.0)
        self.threshold_energy = opens * opens * opens
        self._close_below = closes * closes * closes
        self._quiet_below = quiet * quiet * quiet
