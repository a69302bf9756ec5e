"""How the drive differs from frame to frame, which says nothing of fingers: it comes late, or louder.

A trigger that jitters delays all channels alike. A drive that follows its supply is louder in one frame and fainter in
the next, by a share that may slope along the chirp: the supply's ripple goes on while the chirp rises in frequency.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Acquisition

Signal = NDArray[np.floating]
CHANGES = 16.0
"""Power along a direction, over a sample's noise, from which the gate leaves it out: 0.5 ns of jitter at 60 dB, or 0.01
% of level."""
_FEWEST_FRAMES = 8
"""Fewer do not tell."""


def along_band(acquisition: Acquisition, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where frequencies lie along the chirp's band, from -1 at its lower end to 1; beyond it as at its ends."""
    low_hz, high_hz = acquisition.chirp.band_hz
    return np.asarray(np.clip((2 * frequency_hz - low_hz - high_hz) / (high_hz - low_hz), -1, 1))


def drive_changes(acquisition: Acquisition, mean: Signal, residuals: Signal) -> Signal | None:
    """Return the directions in which the drive changes the residuals of untouched frames, unless noise hides them.

    They are the derivative of the mean by time, the mean, and the mean times where its frequencies lie in the band,
    corrected by what the residuals have in common with each, as at the frame's ends. Slow movement, as of a plate that
    warms, is none: only differences of successive frames count.

    Parameters
    ----------
    acquisition : Acquisition
    mean : array of shape (channels, samples)
    residuals : array of shape (n, channels, samples)

    Returns
    -------
    array of shape (up to 3, channels * samples), orthonormal, or None
    """
    flat = residuals.reshape(len(residuals), -1)
    samples = mean.shape[1]
    spectrum = np.fft.rfft(mean.astype(np.float64), axis=1)
    frequency_hz = np.arange(spectrum.shape[1]) * acquisition.sample_rate_hz / samples
    by = np.stack([2j * np.pi * frequency_hz, np.ones(spectrum.shape[1]), along_band(acquisition, frequency_hz)])
    rows = np.fft.irfft(by[:, None] * spectrum, samples).reshape(len(by), -1)
    if not (np.linalg.norm(rows, axis=1) > 0).all() or len(flat) < _FEWEST_FRAMES:
        return None
    directions = np.linalg.qr(rows.T)[0]
    along, steps = flat @ directions, np.diff(flat, axis=0)
    steps_along = steps @ directions
    rest = steps - steps_along @ directions.T
    found = np.square(steps_along).sum(axis=0) > CHANGES * np.square(rest).sum() / flat.shape[1]
    if not found.any() or not rest.any():
        return None
    # Another pane's chirp is like this plate's signal, too, but holds more that is not; more than noise in any one
    # direction (Marchenko and Pastur, Math. USSR-Sbornik 1:457, 1967; steps of white noise have up to twice as much).
    most = 2 * np.square(rest).mean() * (math.sqrt(len(rest)) + math.sqrt(rest.shape[1])) ** 2
    found[1:] &= np.square(steps_along[:, 1:]).sum(axis=0) > np.linalg.norm(rest, 2) ** 2 - most
    if not found.any():
        return None
    common = np.linalg.lstsq(along[:, found], flat, rcond=None)[0]
    return np.asarray(np.linalg.qr(common.T)[0].T, mean.dtype)
