"""What a warmer or cooler plate does to the features: its response is stretched in time, the chirp is not.

A plate that warms gets slower, by the same share at every frequency: what it answered to an impulse at t it
now answers at t (1 - s). The chirp that it is struck with stays as it was. So the part of the signal about
the frequency f, emitted at the time tau(f), is stretched about tau(f) and not about the start of the frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Acquisition

Floats = NDArray[np.float64]


def emission_s(acquisition: Acquisition, bins: NDArray[np.int64]) -> Floats:
    """Return when the linear chirp passes the frequency of each bin, s after the frame's start, shape (bins,)."""
    chirp = acquisition.chirp
    f_hz = np.asarray(bins) * acquisition.sample_rate_hz / acquisition.samples
    return np.asarray((f_hz - chirp.start_hz) / (chirp.stop_hz - chirp.start_hz) * chirp.duration_s)


def stretch_matrix(acquisition: Acquisition, bins: NDArray[np.int64]) -> Floats:
    """Return the matrix from samples to the derivative of the windowed bins by a stretch of the plate's response.

    A signal y of shape (..., samples) whose plate has become slower or faster since has the features
    y @ windowed_dft + s * (y @ stretch_matrix): s is the relative rise of all its resonances' frequencies, -4.5e-5 a
    kelvin for the twin's glass.

    Parameters
    ----------
    acquisition : Acquisition
    bins : array of int, shape (b,)
        Indices of the DFT bins.

    Returns
    -------
    array of float64, shape (samples, 2 * b)
        Columns as `touchd.localization.features.windowed_dft` orders them: real parts, then imaginary parts.
    """
    n, rate_hz = acquisition.samples, acquisition.sample_rate_hz
    bins = np.asarray(bins)
    # The features are a sum over samples of the derivative y'(t) times t - tau(f), window and phase. The index product
    # is reduced modulo the length first: cos of a large argument loses digits.
    phase = (np.outer(np.arange(n), bins) % n) * (2 * np.pi / n)
    later_s = np.arange(n)[:, None] / rate_hz - emission_s(acquisition, bins)
    weight = np.hanning(n)[:, None] * later_s
    # y' is that of the band-limited signal, a product with i omega: the transpose of that step, applied to the weights.
    slope = 2j * np.pi * np.fft.rfftfreq(n, 1 / rate_hz)
    if n % 2 == 0:
        slope[-1] = 0.0  # the alternating signal has no slope at its samples

    def derived(columns: Floats) -> Floats:
        return np.asarray(np.fft.irfft(-slope[:, None] * np.fft.rfft(columns, axis=0), n, axis=0))

    return np.concatenate([derived(weight * np.cos(phase)), derived(-weight * np.sin(phase))], axis=1)
