"""How the untouched plate's signal changes: with temperature, with the trigger, with gains, with cables.

A plate that warms gets slower, by the same share at every frequency: what it answered to an impulse at t it now answers
at t (1 - s). The chirp that it is struck with stays as it was. So the part of the signal about the frequency f, emitted
at the time tau(f), is stretched about tau(f) and not about the start of the frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.frame import HANN, Acquisition

Floats = NDArray[np.float64]

_LEAD = 0.1
"""Share of the period by which a bin's answer, sharp in frequency, begins before its frequency is emitted."""


def drive_waves(acquisition: Acquisition) -> Floats:
    """Return the waves that a channel may hear of the drive, shape (4, samples).

    The chirp and what a capacitance makes of it, its derivative, and both a quarter of a wave later, for filters. As
    the chirp is sampled: what the converters' filters do beyond the band is in no bin.
    """
    chirp, t_s = acquisition.chirp, np.arange(acquisition.samples) / acquisition.sample_rate_hz
    rate = (chirp.stop_hz - chirp.start_hz) / chirp.duration_s
    phase, f = 2 * np.pi * (chirp.start_hz + rate * t_s / 2) * t_s, (chirp.start_hz + rate * t_s) / chirp.stop_hz
    return np.asarray(
        (t_s < chirp.duration_s) * np.stack([np.sin(phase), f * np.cos(phase), np.cos(phase), f * np.sin(phase)])
    )


def emission_s(acquisition: Acquisition, bins: NDArray[np.int64]) -> Floats:
    """Return when the linear chirp passes the frequency of each bin, s after the frame's start, shape (bins,)."""
    chirp = acquisition.chirp
    f_hz = np.asarray(bins) * acquisition.sample_rate_hz / acquisition.samples
    return np.asarray((f_hz - chirp.start_hz) / (chirp.stop_hz - chirp.start_hz) * chirp.duration_s)


def stretch_matrix(acquisition: Acquisition, bins: NDArray[np.int64], taper: float = HANN) -> Floats:
    """Return the matrix from samples to the derivative of the windowed bins by a stretch of the plate's response.

    A signal y of shape (..., samples) whose plate has become slower or faster since has the features
    y @ windowed_dft + s * (y @ stretch_matrix): s is the relative rise of all its resonances' frequencies, -4.5e-5 a
    kelvin for the twin's glass.

    Parameters
    ----------
    acquisition : Acquisition
    bins : array of int, shape (b,)
        Indices of the DFT bins.
    taper : float
        Of their window.

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
    period_s = acquisition.chirp.period_s
    if period_s is not None:  # what comes before the chirp's own answer is the ringing of the one before
        later_s = (later_s + _LEAD * period_s) % period_s - _LEAD * period_s
    weight = acquisition.window(taper)[:, None] * later_s
    # y' is that of the band-limited signal, a product with i omega: the transpose of that step, applied to the weights.
    slope = 2j * np.pi * np.fft.rfftfreq(n, 1 / rate_hz)
    if n % 2 == 0:
        slope[-1] = 0.0  # the alternating signal has no slope at its samples

    def derived(columns: Floats) -> Floats:
        return np.asarray(np.fft.irfft(-slope[:, None] * np.fft.rfft(columns, axis=0), n, axis=0))

    return np.concatenate([derived(weight * np.cos(phase)), derived(-weight * np.sin(phase))], axis=1)


def delayed(bins: Floats, omega_rad_s: Floats) -> Floats:
    """Return what a delay of a second adds to bins (channels, 2 * bins) in first order: -i omega times them."""
    count = len(omega_rad_s)
    return np.concatenate([omega_rad_s * bins[:, count:], -omega_rad_s * bins[:, :count]], axis=1)


def plate_directions(bins: Floats, stretched: Floats, omega_rad_s: Floats) -> Floats:
    """Return the orthonormal directions in which the untouched plate can move: stretch, delay, and each gain.

    Parameters
    ----------
    bins : array of shape (channels, 2 * bins)
        Of the untouched plate; zero in dead channels.
    stretched : array of the same shape
        Their derivative by a stretch.
    omega_rad_s : array of shape (bins,)

    Returns
    -------
    array of shape (up to 2 + channels, channels * 2 * bins), without rows on a rig that hears nothing.
    """
    rows = [stretched, delayed(bins, omega_rad_s)]
    rows += [np.where(np.arange(len(bins))[:, None] == r, bins, 0.0) for r in np.flatnonzero(bins.any(axis=1))]
    table = np.stack([row.ravel() for row in rows])
    norm = np.linalg.norm(table, axis=1, keepdims=True)
    if not (norm > 0).all():
        return np.zeros((0, bins.size))
    return np.asarray(np.linalg.qr((table / norm).T)[0].T)
