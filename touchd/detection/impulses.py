"""Electromagnetic impulses: find the few samples of a frame that one has hit, and blank them.

An impulse has all frequencies, the chirp only its band. So energy far outside the band, beyond that of the noise, is an
impulse, whether a finger is on the plate or not. The samples that explain it are blanked in all channels; who places
fingers solves for them as unknowns (`touchd.localization.nuisance`).

In steady state a contact has no energy between the chirp's lines and below its band, and what is there comes of a
knock. Too few frequencies are left to tell where in the frame an impulse is.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.frame import Acquisition

Signal = NDArray[np.floating]

WIDTH = 7
"""Samples blanked for an impulse of up to four: where noise leaves its place in doubt, it lies within."""
MOST = 3
"""Impulses in one frame; more are noise of another kind, and stay."""
LOUD = 2.0
"""A frame is hit if it has this multiple of the noise's energy outside the band: six standard deviations."""
LEAK = 0.12
"""Energy outside the band, over that of the samples, that a finger may have: thumbs have up to 0.07, since the chirp
starts at full amplitude (twin). An impulse with a thousandth of the finger's energy has more."""
_TAPER = 0.5
"""Of the window: Hann's attenuates impulses near the frame's ends, to which an atlas with its flatter window is
sensitive."""
_FIRST_BIN = 3
"""Offsets lie below."""
_BELOW, _ABOVE = 0.5, 0.2
"""Distance of the bins used from the chirp's band, in widths of it: where a finger leaks less than noise."""
_BELOW_LINES, _LINES_LEAK = 0.6, 0.005
"""In steady state bins up to this share of the band's lower edge are used, where fingers that land and move have up to
0.002 of the samples' energy; up to 0.8 a resonance may have 0.04 (twin)."""
_FEWEST_BINS, _FEWEST_LINES = 8, 5
_WEAK = 0.02
"""Combinations of samples that show less than this outside the band, over the strongest, are not told from noise."""
MEMORY_FRAMES = 64
TONE_FRAMES, SELDOM = 8, 16
"""Noise outside the band that no few samples explain in 8 frames in a row, as a tone, is searched in every 16th."""
_FEWEST_FRAMES = 8
"""Fewer do not tell the noise."""


class Impulses:
    """Knows the noise outside the band, and blanks what is louder and lasts for a few samples.

    Parameters
    ----------
    acquisition : Acquisition
    dtype : type
        Of the residuals.
    above : float
        Share of the band's lower edge up to which something is left of hum or sound that is taken out of them.
    """

    def __init__(self, acquisition: Acquisition, dtype: DTypeLike = np.float32, *, above: float = 0.0) -> None:
        n = acquisition.samples
        bins = _bins_outside(acquisition, above)
        phase = (np.outer(np.arange(n), bins) % n) * (2 * np.pi / n)
        matrix = acquisition.window(_TAPER)[:, None] * np.concatenate([np.cos(phase), -np.sin(phase)], axis=1)
        self._tells_when = not acquisition.is_whole_period
        self._works = len(bins) >= (_FEWEST_BINS if self._tells_when else _FEWEST_LINES) and n > 2 * WIDTH
        self._leak = LEAK if self._tells_when else _LINES_LEAK * n / 2
        self._matrix: Signal = matrix.astype(dtype)
        self._outside: Signal = np.zeros((acquisition.channels, 2 * len(bins)), dtype)
        self._flat, self._energy = self._outside.reshape(-1), np.zeros((), dtype)
        self._blocks: Signal | None = None  # made for the first impulse
        self._level = 0.0
        self._frames = 0
        self.in_vain = 0
        """Frames in a row with noise outside the band that lasts longer than an impulse, as after a knock."""

    def learn(self, frames: Signal) -> NDArray[np.bool_]:
        """Estimate the noise outside the band from frames of the untouched plate, (n, channels, samples).

        Returns
        -------
        array of bool, shape (n,)
            Which frames an impulse has hit.
        """
        self._level = 0.0
        if not self._works or len(frames) < _FEWEST_FRAMES:
            return np.zeros(len(frames), bool)
        # Against the median, in which an impulse leaves no trace.
        loudness = np.array([self.loudness(residual) for residual in frames - np.median(frames, axis=0)])
        self._level = float(np.percentile(loudness, 25))
        self._frames = len(frames)
        return np.asarray(loudness > LOUD * self._level)

    def update(self, residual: Signal) -> None:
        """Follow the noise by an untouched frame, (channels, samples)."""
        if self._works and self._level:
            self._frames = min(self._frames + 1, MEMORY_FRAMES)
            # An impulse counts as the loudest noise.
            loudness = min(self.loudness(residual), LOUD * self._level)
            self._level += (loudness - self._level) / self._frames

    def blank(self, residual: Signal, energy: float) -> tuple[int, ...]:
        """Set the samples that impulses have hit to zero, in place, and return where each run of `WIDTH` starts.

        Parameters
        ----------
        residual : array of shape (channels, samples)
        energy : float
            Its energy, counts squared.
        """
        limit, loudness = self.most(energy), self.loudness(residual)
        if loudness <= limit:
            self.in_vain = 0
            return ()
        if not self._tells_when or (self.in_vain >= TONE_FRAMES and self.in_vain % SELDOM):
            self.in_vain += 1
            return ()
        if self._blocks is None:
            self._blocks = self._make_blocks()
        starts: list[int] = []
        outside = self._outside
        while loudness > limit and len(starts) < MOST:
            along = self._blocks @ outside.T
            start = int(np.square(along).sum(axis=1).reshape(-1, WIDTH).sum(axis=1).argmax())
            rows = slice(WIDTH * start, WIDTH * (start + 1))
            outside -= along[rows].T @ self._blocks[rows]
            starts.append(start)
            self._flat.dot(self._flat, self._energy)
            loudness = self._energy.item()
        if loudness > limit:
            self.in_vain += 1
            return ()
        self.in_vain = 0
        for start in starts:
            residual[:, start : start + WIDTH] = 0
        return tuple(starts)

    def most(self, energy: float) -> float:
        """Return what noise and fingers have outside the band at most, in a residual of this energy."""
        return LOUD * self._level + self._leak * energy if self._level else math.inf

    def loudness(self, residual: Signal) -> float:
        """Return the energy of a residual outside the band."""
        residual.dot(self._matrix, self._outside)
        self._flat.dot(self._flat, self._energy)
        loudness: float = self._energy.item()
        return loudness

    def _make_blocks(self) -> Signal:
        """Return what runs of samples can be outside the band: orthonormal rows, `WIDTH` for each start."""
        runs = np.lib.stride_tricks.sliding_window_view(self._matrix.astype(np.float64), WIDTH, axis=0).swapaxes(1, 2)
        _, size, rows = np.linalg.svd(runs, full_matrices=False)
        told = size > _WEAK * size.max()
        return np.asarray((rows * told[..., None]).reshape(-1, rows.shape[-1]).astype(self._matrix.dtype))


def _bins_outside(acquisition: Acquisition, above: float) -> NDArray[np.int64]:
    """Return the bins far from the chirp's band, on both sides; in steady state those below it."""
    f_hz = np.arange(acquisition.samples // 2) * acquisition.sample_rate_hz / acquisition.samples
    low, high = acquisition.chirp.band_hz
    if acquisition.is_whole_period:
        outside = f_hz < _BELOW_LINES * low
    else:
        outside = (f_hz < low - _BELOW * (high - low)) | (f_hz > high + _ABOVE * (high - low))
    outside[:_FIRST_BIN] = False
    outside[f_hz < above * low] = False
    return np.flatnonzero(outside)
