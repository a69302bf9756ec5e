"""A trigger that jitters delays all channels alike, which says nothing of fingers: the direction of a delay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Signal = NDArray[np.floating]
DELAYED = 16.0
"""Power along a delay, over a sample's noise, from which the gate leaves it out: 0.5 ns of jitter at 60 dB."""
_FEWEST_DELAYED = 8
"""Fewer frames do not tell the jitter."""


def delay_direction(mean: Signal, residuals: Signal) -> Signal | None:
    """Return the direction of a delay in the residuals of untouched frames, unless noise hides it.

    It is the derivative of the mean by time, corrected at the frame's ends by what the residuals have in common with
    it. Slow movement, as of a plate that warms, is no jitter: only differences of successive frames count.

    Parameters
    ----------
    mean : array of shape (channels, samples)
    residuals : array of shape (n, channels, samples)

    Returns
    -------
    array of shape (channels * samples,), of length 1, or None
    """
    flat = residuals.reshape(len(residuals), -1)
    spectrum = np.fft.rfft(mean.astype(np.float64), axis=1)
    slope = np.fft.irfft(2j * np.pi * np.arange(spectrum.shape[1]) * spectrum, mean.shape[1], axis=1).reshape(-1)
    length = float(np.linalg.norm(slope))
    if not length > 0 or len(flat) < _FEWEST_DELAYED:
        return None
    along = flat @ (slope / length)
    variance = float(np.square(np.diff(flat, axis=0)).mean()) / 2
    if not np.square(np.diff(along)).mean() / 2 > DELAYED * variance > 0:
        return None
    common = along @ flat
    return np.asarray(common / np.linalg.norm(common), mean.dtype)
