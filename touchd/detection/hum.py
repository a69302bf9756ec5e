"""Mains hum, offsets and a machine's vibration: take what lies far below the chirp's band out of residuals.

A piezoceramic disc of 300 pF at an input of high impedance, on a cable without a shield, picks up more of the mains
than of the plate: 1 pF to a wire at 230 V is 70 nA, 70 mV in 1 Mohm, beside some 300 mV of signal. In a frame of a
millisecond that is an offset and a slope, another in each frame, in which no energy of a finger could be told. Sound
reaches higher frequencies: at 94 dB (1 Pa) it moves 5 mm of glass at 10 kHz by 1e-3 mm/s; what a disc makes of that was
not measured.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.frame import Acquisition

Signal = NDArray[np.floating]

BELOW, FAR_BELOW = 0.5, 0.1
"""Up to this share of the band's lower edge frequencies are taken out after a knock and of sound, 25 kHz, and of hum,
5 kHz."""
LOUD = 2.0
"""There is hum where they hold this multiple of what white noise leaves there: six standard deviations."""
LEAK = 0.3
"""And of a touched frame this share of its energy: fingers have up to 0.03 (twin), as a frame cuts off what rings, and
impulses 0.2."""
_MOST_TURNS = 48.0
"""And up to so many turns in a frame: in a longer one than 4 ms more would cost more than they are worth."""
_TOLD = 1e-5
"""Combinations of low frequencies with less than this of a frame, over the most, are none that a frame can tell."""


class Hum:
    """Knows whether there is hum, and takes it out of residuals.

    Parameters
    ----------
    acquisition : Acquisition
    dtype : type
        Of the residuals.
    below : float
        Frequencies up to this share of the band's lower edge are hum.
    """

    def __init__(self, acquisition: Acquisition, dtype: DTypeLike = np.float32, below: float = FAR_BELOW) -> None:
        channels, samples = acquisition.shape
        columns = _low_frequencies(acquisition, below)
        self._columns: Signal = np.ascontiguousarray(columns, dtype)
        self._rows: Signal = np.ascontiguousarray(self._columns.T)
        self._share = columns.shape[1] / samples
        self._along: Signal = np.zeros((channels, columns.shape[1]), dtype)
        self._part: Signal = np.zeros((channels, samples), dtype)
        self._flat, self._energy = self._along.reshape(-1), np.zeros((), dtype)
        self.known = False
        """Whether there has been hum since the plate was learned; then each frame may have some."""

    def learn(self, residuals: Signal) -> bool:
        """Look for hum in untouched frames, (n, channels, samples); remove it, in place, and return whether any is."""
        # Against the median, and in the median frame: an impulse leaves no trace there.
        left = residuals - np.median(residuals, axis=0)
        energy, whole = (float(np.median(np.square(each).sum(axis=(1, 2)))) for each in (left @ self._columns, left))
        self.known = self._is_loud(energy, whole)
        residuals -= self.of(residuals)
        return self.known

    def of(self, frames: NDArray[Any]) -> NDArray[Any] | float:
        """Return the hum in frames or residuals, (..., channels, samples), or 0 without hum."""
        return frames @ self._columns @ self._rows if self.known else 0.0

    @property
    def white_left(self) -> float:
        """Share of white noise's energy that residuals have without hum."""
        return 1 - self._share if self.known else 1.0

    def tells(self, residual: Signal, energy: float) -> bool:
        """Return whether an untouched residual of this energy, counts squared, has far more there than white noise."""
        np.dot(residual, self._columns, self._along)
        self._flat.dot(self._flat, self._energy)
        return self._is_loud(self._energy.item(), energy)

    def _is_loud(self, below: float, energy: float) -> bool:
        """Return whether an energy there is far more than white noise would have beside the rest."""
        return bool(below > LOUD * self._share / (1 - self._share) * (energy - below))

    def find(self, residual: Signal, energy: float, noise_energy: float) -> bool:
        """Look for hum that has begun in a touched frame, (channels, samples); remove it, and return whether any has.

        `energy` is that of the residual, `noise_energy` that of untouched ones, counts squared.
        """
        if self.known:
            return False
        np.dot(residual, self._columns, self._along)
        self._flat.dot(self._flat, self._energy)
        self.known = self._energy.item() > LOUD * self._share * noise_energy + LEAK * energy
        if self.known:
            self.remove(residual)
        return self.known

    def put_back(self, residual: Signal) -> None:
        """Put back what `find` has just removed: it was no hum."""
        self.known = False
        np.add(residual, self._part, residual)

    def remove(self, residual: Signal) -> None:
        """Remove hum from a residual, (channels, samples), in place."""
        np.dot(residual, self._columns, self._along)
        np.dot(self._along, self._rows, self._part)
        np.subtract(residual, self._part, residual)


def _low_frequencies(acquisition: Acquisition, below: float) -> NDArray[np.float64]:
    """Return orthonormal columns, (samples, k), that hold all frequencies far below the band."""
    n, rate_hz = acquisition.samples, acquisition.sample_rate_hz
    seconds = (np.arange(n) - (n - 1) / 2) / rate_hz
    below_hz = min(below * acquisition.chirp.band_hz[0], _MOST_TURNS * rate_hz / n)
    hz = np.linspace(0, below_hz, 2 + int(2 * below_hz * n / rate_hz))
    phase = 2 * np.pi * np.outer(seconds, hz)
    waves = np.concatenate([np.cos(phase), np.sin(phase[:, 1:])], axis=1)
    columns, size, _ = np.linalg.svd(waves, full_matrices=False)
    return np.asarray(columns[:, size > _TOLD * size[0]])
