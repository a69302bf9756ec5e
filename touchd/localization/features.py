"""From a residual to the model's input: the Hann-windowed bins of the chirp's band, or the samples."""

from __future__ import annotations

import math
from typing import Literal, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.frame import Acquisition

Domain = Literal["frequency", "time"]
Vector = NDArray[np.floating]


class Features(Protocol):
    """A route from samples to the model's input."""

    size: int
    shape: tuple[int, int]
    """Of the features with an axis for the channels."""
    noise_gain: float
    """Energy of the features of white noise over that of its samples."""

    def extract(self, signal: Vector, out: Vector) -> None:
        """Write the features of a signal of shape (channels, samples) to `out`, of shape (size,) or `shape`."""
        ...


def band_bins(acquisition: Acquisition) -> NDArray[np.int64]:
    """Return the indices of the DFT bins strictly between the chirp's start and stop frequencies.

    51..99 for the paper's 250 samples at 250 kHz and 50 -> 100 kHz, that is 49 bins (Bahrami et al. 2022, features).
    """
    k = np.arange(acquisition.samples // 2 + 1)
    # Multiplied first: a rounded spacing would push a bin that lies on the edge over it.
    f_hz = k * acquisition.sample_rate_hz / acquisition.samples
    return k[(f_hz > acquisition.chirp.start_hz) & (f_hz < acquisition.chirp.stop_hz)]


def windowed_dft(acquisition: Acquisition, bins: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
    """Return the matrix that takes samples to windowed bins, those of the band or the given ones: (samples, 2 * bins).

    Column b is the real part and column bins + b the imaginary part of bin b of
    `numpy.fft.rfft(numpy.hanning(samples) * signal)`.
    """
    n = np.arange(acquisition.samples)
    # The index product is reduced modulo the length first: cos of a large argument loses digits.
    bins = band_bins(acquisition) if bins is None else bins
    phase = (np.outer(n, bins) % acquisition.samples) * (2 * np.pi / acquisition.samples)
    window = acquisition.window[:, None]
    return np.concatenate([window * np.cos(phase), -window * np.sin(phase)], axis=1)


class FrequencyFeatures:
    """Real and imaginary parts of the windowed bins, channel by channel: 4 x (49 + 49) = 392 for the paper's rig."""

    def __init__(self, acquisition: Acquisition, dtype: DTypeLike = np.float32) -> None:
        self._matrix = windowed_dft(acquisition).astype(dtype)
        self.shape = (acquisition.channels, self._matrix.shape[1])
        self.size = self.shape[0] * self.shape[1]
        # Each bin holds the window's energy times the variance of a sample.
        self.noise_gain = float(np.square(self._matrix, dtype=np.float64).sum()) / acquisition.samples

    def extract(self, signal: Vector, out: Vector) -> None:
        """Write the bins of a signal of shape (channels, samples) to `out`, of shape (size,) or `shape`."""
        np.dot(signal, self._matrix, out=out if out.shape == self.shape else out.reshape(self.shape))


class TimeFeatures:
    """The samples of all channels, one after the other: 4 x 250 = 1000 for the paper's rig."""

    def __init__(self, acquisition: Acquisition) -> None:
        self.shape = acquisition.shape
        self.size = acquisition.channels * acquisition.samples
        self.noise_gain = 1.0

    def extract(self, signal: Vector, out: Vector) -> None:
        """Write the samples of a signal of shape (channels, samples) to `out`, of shape (size,) or `shape`."""
        out[...] = signal.reshape(out.shape)


def noise_to_signal(route: Features, noise_energy: float, energy: float) -> float:
    """Return the norm that white noise has in features over their own norm.

    Parameters
    ----------
    route : Features
        What the features were taken by.
    noise_energy : float
        Energy of the samples of the noise in them, ADC counts squared.
    energy : float
        Of the features.
    """
    return math.sqrt(route.noise_gain * noise_energy / max(energy, 1e-12))


def make_features(domain: Domain, acquisition: Acquisition, dtype: DTypeLike = np.float32) -> Features:
    """Return the features of a domain for an acquisition; `dtype` is that of the matrix."""
    return FrequencyFeatures(acquisition, dtype) if domain == "frequency" else TimeFeatures(acquisition)
