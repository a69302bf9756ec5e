"""Spectrum of the emitted chirp."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.frame import Chirp

Complex = NDArray[np.complex128]


def waveform(chirp: Chirp) -> NDArray[np.float64]:
    """What the DAC plays: a linear chirp of continuous phase and unit amplitude, one value a DAC sample."""
    t = np.arange(round(chirp.duration_s * chirp.dac_rate_hz)) / chirp.dac_rate_hz
    rate = (chirp.stop_hz - chirp.start_hz) / chirp.duration_s
    return np.asarray(np.sin(2 * np.pi * (chirp.start_hz + rate * t / 2) * t))


def spectrum(chirp: Chirp, omega_rad_s: ArrayLike) -> Complex:
    """Fourier transform of the DAC's output, each value held for one DAC sample; exact at any complex frequency.

    Parameters
    ----------
    chirp : Chirp
    omega_rad_s : array_like of shape (F,), real or complex, not zero

    Returns
    -------
    Complex array of shape (F,), in s.
    """
    omega = np.asarray(omega_rad_s, dtype=np.complex128)
    played = waveform(chirp)
    step = 1 / chirp.dac_rate_hz
    hold = (1 - np.exp(-1j * omega * step)) / (1j * omega)
    return np.asarray(hold * (np.exp(-1j * np.outer(omega, step * np.arange(len(played)))) @ played))
