"""Remove what lies far below the chirp's band: an audio interface passes mains hum and the thump of a finger, too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.audio.card import Floats, Samples

_AVERAGES = 3
_TOP = 2**15 - 1
_BLOCK = 48  # samples that one row of the product filters


class HighPass:
    """A signal less the triple moving average over a wavelength of the band's start.

    It keeps the band to within 1 %, and leaves -37 dB of a thump at a twentieth of the band's start, -90 dB of mains
    hum. It is symmetric, so it delays nothing. A matrix product with blocks of the signal takes a third of the time of
    a convolution.

    Parameters
    ----------
    start_hz, rate_hz : float
        Start of the chirp's band, and the sample rate.
    channels, samples : int
        Of a filtered frame.
    """

    def __init__(self, start_hz: float, rate_hz: float, channels: int, samples: int) -> None:
        length = 2 * max(round((rate_hz / start_hz - 1) / 2), 1) + 1
        average = np.ones(1)
        for _ in range(_AVERAGES):
            average = np.convolve(average, np.full(length, 1 / length))
        self.margin = len(average) // 2
        """Samples that `apply` needs before and after those that it returns."""
        self._kernel = -average
        self._kernel[self.margin] += 1
        width = _BLOCK + len(average) - 1
        self._matrix: NDArray[np.float32] = np.zeros((width, _BLOCK), np.float32)
        for at in range(_BLOCK):
            self._matrix[at : at + len(average), at] = self._kernel
        blocks = -(-samples // _BLOCK)
        self._signal: NDArray[np.float32] = np.zeros((channels, blocks * _BLOCK + width - _BLOCK), np.float32)
        self._input = self._signal[:, : samples + 2 * self.margin]
        self._windows = np.lib.stride_tricks.sliding_window_view(self._signal, width, axis=1)[:, ::_BLOCK]
        self._filtered: NDArray[np.float32] = np.zeros((channels, blocks, _BLOCK), np.float32)
        self.filtered: NDArray[np.float32] = self._filtered.reshape(channels, -1)[:, :samples]
        """What `apply` returned last, as floats."""

    def apply(self, counts: NDArray[np.generic]) -> Samples:
        """Return the filtered samples of counts of shape (channels, samples + 2 * margin), (channels, samples)."""
        self._input[:] = counts
        np.matmul(self._windows, self._matrix, out=self._filtered)
        np.rint(self.filtered, out=self.filtered)
        self.filtered.clip(-_TOP - 1, _TOP, out=self.filtered)
        return self.filtered.astype(np.int16)

    def clips(self, filtered: Samples) -> bool:
        """Return whether the last counts were at the converter's limit; samples that were shall show it filtered."""
        if self._input.max() < _TOP and self._input.min() > -_TOP:
            return False
        counts = self._input[:, self.margin : self.margin + filtered.shape[1]]
        filtered[counts >= _TOP] = _TOP
        filtered[counts <= -_TOP] = -_TOP - 1
        return True

    def around(self, period: Floats) -> Floats:
        """Return filtered periodic signals, shape (..., period)."""
        kernel = np.zeros(period.shape[-1])
        np.add.at(kernel, np.arange(-self.margin, self.margin + 1) % len(kernel), self._kernel)
        return np.asarray(np.fft.irfft(np.fft.rfft(period) * np.fft.rfft(kernel).real, period.shape[-1]))
