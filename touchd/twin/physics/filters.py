"""What filters on the way from a disc to a frame leave of a frequency."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.frame import Acquisition

Complex = NDArray[np.complex128]


def anti_alias(omega_rad_s: ArrayLike, sample_rate_hz: float) -> Complex:
    """Return the gain of the anti-alias filter: 1 up to 80 % of half the sample rate, -87 dB at half the rate.

    It is an analytic function, so it is the same filter at complex frequencies.
    """
    f = np.asarray(omega_rad_s, np.complex128) / (np.pi * sample_rate_hz)
    return np.asarray(1 / (1 + np.exp((f - 0.92) / 0.008)))


def high_pass(omega_rad_s: ArrayLike, acquisition: Acquisition) -> Complex:
    """Return the gain below the chirp's band: 1 of a DAQ, that of `touchd.audio.capture.HighPass` in steady state.

    An audio interface passes mains hum, and touchd takes it out before it cuts frames: a triple moving average over a
    wavelength of the band's lower edge.
    """
    omega = np.asarray(omega_rad_s, np.complex128)
    if acquisition.chirp.period_s is None:
        return np.ones_like(omega)
    rate_hz, low_hz = acquisition.sample_rate_hz, acquisition.chirp.band_hz[0]
    length = 2 * max(round((rate_hz / low_hz - 1) / 2), 1) + 1
    half = omega / (2 * rate_hz)
    still = np.abs(half) < 1e-12
    average = np.where(still, 1.0, np.sin(length * half) / (length * np.sin(np.where(still, 1.0, half))))
    return np.asarray(1 - average**3)
