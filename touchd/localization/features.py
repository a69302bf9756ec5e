"""From a residual to the model's input: the windowed bins of the chirp's band, or the samples."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.frame import HANN, Acquisition

Domain = Literal["frequency", "time"]
Vector = NDArray[np.floating]


def band_bins(acquisition: Acquisition) -> NDArray[np.int64]:
    """Return the indices of the DFT bins strictly within the chirp's band, whether it rises or falls.

    51..99 for the paper's 250 samples at 250 kHz and 50 -> 100 kHz, that is 49 bins (Bahrami et al. 2022, features).
    """
    k = np.arange(acquisition.samples // 2 + 1)
    # Multiplied first: a rounded spacing would push a bin that lies on the edge over it.
    f_hz = k * acquisition.sample_rate_hz / acquisition.samples
    low_hz, high_hz = acquisition.chirp.band_hz
    return k[(f_hz > low_hz) & (f_hz < high_hz)]


def windowed_dft(
    acquisition: Acquisition, bins: NDArray[np.int64] | None = None, taper: float = HANN
) -> NDArray[np.float64]:
    """Return the matrix that takes samples to windowed bins, those of the band or the given ones: (samples, 2 * bins).

    Column b is the real part and column bins + b the imaginary part of bin b of
    `numpy.fft.rfft(acquisition.window(taper) * signal)`.
    """
    n = np.arange(acquisition.samples)
    # The index product is reduced modulo the length first: cos of a large argument loses digits.
    bins = band_bins(acquisition) if bins is None else bins
    phase = (np.outer(n, bins) % acquisition.samples) * (2 * np.pi / acquisition.samples)
    window = acquisition.window(taper)[:, None]
    return np.concatenate([window * np.cos(phase), -window * np.sin(phase)], axis=1)


class Features:
    """A route from samples to the model's input.

    In the frequency domain these are real and imaginary parts of the windowed bins, channel by channel: 4 x (49 + 49) =
    392 for the paper's rig. In the time domain they are the samples of all channels, one after the other: 4 x 250.

    Parameters
    ----------
    domain : Domain
    acquisition : Acquisition
    dtype : type
        Of the matrix.
    taper : float
        Of the bins' window.
    """

    def __init__(
        self, domain: Domain, acquisition: Acquisition, dtype: DTypeLike = np.float32, taper: float = HANN
    ) -> None:
        self._matrix: Vector | None = None
        self.shape = acquisition.shape
        """Of the features with an axis for the channels."""
        self.noise_gain = 1.0
        """Energy of the features of white noise over that of its samples."""
        if domain == "frequency":
            self._matrix = windowed_dft(acquisition, taper=taper).astype(dtype)
            self.shape = acquisition.channels, self._matrix.shape[1]
            # Each bin holds the window's energy times the variance of a sample.
            self.noise_gain = float(np.square(self._matrix, dtype=np.float64).sum()) / acquisition.samples
        self.size = self.shape[0] * self.shape[1]

    def extract(self, signal: Vector, out: Vector) -> None:
        """Write the features of a signal of shape (channels, samples) to `out`, of shape (size,) or `shape`."""
        if self._matrix is None:
            out[...] = signal.reshape(out.shape)
        else:
            np.dot(signal, self._matrix, out=out if out.shape == self.shape else out.reshape(self.shape))

    def noise_to_signal(self, noise_energy: float, energy: float) -> float:
        """Return the norm that white noise has in the features over their own norm.

        `noise_energy` is that of the noise's samples, `energy` that of the features, ADC counts squared.
        """
        return math.sqrt(self.noise_gain * noise_energy / max(energy, 1e-12))
