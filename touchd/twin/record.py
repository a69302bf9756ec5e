"""From responses at complex frequencies to the time signal of one frame, after silence or in steady state.

After silence the record is two frames long, damped by exp(-13) and undamped afterwards, so that ringing beyond it does
not wrap around into the frame: -110 dB. In steady state chirps follow each other with one period, and signals consist
of its harmonics: the record is one period, and what wraps around is what still rings.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Acquisition

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

_FRAMES, _DAMPING = 2, 13.0
_LEAST_DECAY_PER_S = 1e-3
"""Keeps frequencies off zero, where a free plate has no response."""


class Record:
    """The frequencies of a frame's record, and the way back to its samples: F frequencies, S samples.

    The period of the acquisition's chirp tells steady state. Raises SimulationError if the chirp does not fit into the
    frame, or the frame not into the period.
    """

    def __init__(self, acquisition: Acquisition) -> None:
        a = acquisition
        period_s = a.chirp.period_s
        frame_s = a.samples / a.sample_rate_hz
        if a.chirp.duration_s > frame_s * (1 + 1e-9):
            raise SimulationError("the chirp is longer than the frame", "acquisition", "record more samples")
        if period_s is not None and period_s < frame_s * (1 - 1e-9):
            what = "chirps follow each other faster than frames last"
            raise SimulationError(what, "acquisition", "use a longer period")
        self.steady = period_s is not None
        self.length = _FRAMES * a.samples if period_s is None else round(period_s * a.sample_rate_hz)
        self.decay_per_s = 0.0 if self.steady else _DAMPING * a.sample_rate_hz / self.length
        self.hz: Floats = np.arange(self.length // 2 + 1) * a.sample_rate_hz / self.length
        self.nu_rad_s: Complex = np.asarray(
            2 * np.pi * self.hz - 1j * max(self.decay_per_s, _LEAST_DECAY_PER_S), np.complex128
        )
        self.time_s: Floats = np.arange(a.samples) / a.sample_rate_hz
        self._undamp = np.exp(self.decay_per_s * self.time_s) * a.sample_rate_hz

    def waves(self, spectrum: Complex) -> Floats:
        """Return the damped signals per sample of spectra of shape (..., F), shape (..., S)."""
        return np.asarray(np.fft.irfft(spectrum, self.length, axis=-1)[..., : len(self.time_s)])

    def to_time(self, spectrum: Complex) -> Floats:
        """Return the signals of spectra of shape (..., F), shape (..., S)."""
        return self.waves(spectrum) * self._undamp
