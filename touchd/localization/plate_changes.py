"""How the untouched plate's signal changes: with temperature, with the trigger, with gains, with cables and bodies.

A plate that warms gets slower, by the same share at every frequency: what it answered to an impulse at t it now answers
at t (1 - s). The chirp that it is struck with stays as it was. So the part of the signal of the frequency f, emitted at
the time tau(f), is stretched about tau(f) and not about the start of the frame.

Where earlier chirps ring on for as long as a period and longer, as those of an audio interface on glass, a frame does
not tell when what it holds was emitted: then this explains half of a change, or nothing of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.frame import HANN, Acquisition
from touchd.localization.features import windowed_dft

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


def stretched_dft(
    acquisition: Acquisition, bins: NDArray[np.int64], stretch: float, taper: float = HANN
) -> tuple[Floats, Floats]:
    """Return the matrix from samples to the windowed bins that a plate has after a stretch, and its derivative by it.

    Parameters
    ----------
    acquisition : Acquisition
    bins : array of int, shape (b,)
        Indices of the DFT bins.
    stretch : float
        Relative rise of all resonances' frequencies since the samples were taken: -4.5e-5 a kelvin for the twin's
        glass, six times as much for aluminium, twenty times for acrylic.
    taper : float
        Of the bins' window.

    Returns
    -------
    matrix, derivative : arrays of float64, shape (samples, 2 * b)
        Columns as `touchd.localization.features.windowed_dft` orders them: real parts, then imaginary parts.
    """
    n, rate_hz, period_s = acquisition.samples, acquisition.sample_rate_hz, acquisition.chirp.period_s
    t, waves = np.arange(n), np.arange(n // 2 + 1)
    omega_rad_s, t_s = 2 * np.pi * waves * rate_hz / n, t / rate_hz
    later_s = t_s[:, None] - emission_s(acquisition, waves)
    if period_s is not None:  # what comes before the chirp's own answer is the ringing of the one before
        later_s = (later_s + _LEAD * period_s) % period_s - _LEAD * period_s
    later_s[:, 0] = later_s[:, n - n // 2 :] = 0.0  # neither the mean nor what alternates is an answer
    # The higher wave that one becomes was emitted later: in second order by a rate, s^2.
    rate_s2 = acquisition.chirp.duration_s / (2 * np.pi * (acquisition.chirp.stop_hz - acquisition.chirp.start_hz))
    phase = omega_rad_s * (t_s[:, None] + stretch * later_s) - rate_s2 / 2 * (stretch * omega_rad_s) ** 2
    cos, sin = np.cos(phase), np.sin(phase)
    slope = omega_rad_s * (later_s - rate_s2 * stretch * omega_rad_s)
    # The index product is reduced modulo the length first: cos of a large argument loses digits.
    turn = (np.outer(t, waves) % n) * (2 * np.pi / n)
    share = np.where((waves == 0) | (2 * waves == n), 1, 2) / n  # a wave has two lines but for these
    to_waves = np.concatenate([share * np.cos(turn), share * np.sin(turn)], axis=1)
    plain = windowed_dft(acquisition, bins, taper)
    matrix, derivative = (
        to_waves @ (np.concatenate(moved, axis=1).T @ plain) for moved in ((cos, sin), (-slope * sin, slope * cos))
    )
    return matrix, derivative


def delayed(bins: Floats, omega_rad_s: Floats) -> Floats:
    """Return what a delay of a second adds to bins (channels, 2 * bins) in first order: -i omega times them."""
    count = len(omega_rad_s)
    return np.concatenate([omega_rad_s * bins[:, count:], -omega_rad_s * bins[:, :count]], axis=1)


def plate_directions(bins: Floats, stretched: Floats, omega_rad_s: Floats, drive: Floats | None = None) -> Floats:
    """Return the orthonormal directions in which the untouched plate can move: stretch, delay, and in each channel.

    There its gain changes, and how much of the drive it hears: a hand near the cables couples it, touching or not.

    Parameters
    ----------
    bins : array of shape (channels, 2 * bins)
        Of the untouched plate; zero in dead channels.
    stretched : array of the same shape
        Their derivative by a stretch.
    omega_rad_s : array of shape (bins,)
    drive : array of shape (channels, k, 2 * bins), optional
        What each channel may hear of the drive.

    Returns
    -------
    array of shape (up to 2 + (k + 1) * channels, channels * 2 * bins), without rows on a rig that hears nothing.
    """
    rows = [stretched, delayed(bins, omega_rad_s)]
    for channel in np.flatnonzero(bins.any(axis=1)):
        own = bins[channel, None] if drive is None else np.concatenate([bins[channel, None], drive[channel]])
        rows += list(np.where(np.arange(len(bins))[:, None] == channel, own[:, None], 0.0))
    table = np.stack([row.ravel() for row in rows])
    norm = np.linalg.norm(table, axis=1, keepdims=True)
    if not (norm > 0).all():
        return np.zeros((0, bins.size))
    return np.asarray(np.linalg.qr((table / norm).T)[0].T)
