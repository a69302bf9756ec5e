"""Estimators that compare a frame with every recorded touch: kNN and GCC.

They need no training, but memory and time for all recorded touches, which is the source paper's argument against them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import complex_bins

Rows = NDArray[np.float32]

LAGS_S = np.arange(-8, 9, 2) * 1e-6
"""Delays at which two signals are compared: up to two samples of the reference acquisition."""


class Nearest:
    """kNN with k = 1, as in the paper: the position of the nearest of recorded touches (n, inputs) at (n, 2) mm."""

    def __init__(self, features: Rows, position_mm: Rows) -> None:
        self._mean = features.mean(axis=0)  # less it, sums of squares are not much larger than their differences
        self._kept = features - self._mean
        self._energy = np.square(self._kept).sum(axis=1)
        self._position_mm = position_mm
        self.bytes = self._kept.nbytes

    def locate(self, features: Rows) -> Rows:
        """Return the positions (m, 2) in mm for features (m, inputs)."""
        distance2 = self._energy - 2 * (features - self._mean) @ self._kept.T  # less the energy of the frame
        return np.asarray(self._position_mm[distance2.argmin(axis=1)])


class Correlation:
    """GCC: the position of the recorded touch with the highest generalised cross-correlation.

    All bins have equal weight (phase transform, PHAT: Knapp and Carter, IEEE Trans. ASSP 24(4), 1976). The correlations
    of the channels are summed, and their peak is sought within `LAGS_S`.

    `features`, of shape (n, inputs), are the real and imaginary parts of the bins, channel by channel, and `f_hz`, of
    shape (bins,), the bins' frequencies.
    """

    def __init__(self, features: Rows, position_mm: Rows, channels: int, f_hz: NDArray[np.floating]) -> None:
        self._channels = channels
        self._position_mm = position_mm
        turn = np.exp(2j * np.pi * LAGS_S[:, None] * f_hz).astype(np.complex64)
        self._turns = np.tile(turn, channels)
        self._kept = self._whitened(features)
        self.bytes = self._kept.nbytes

    def locate(self, features: Rows) -> Rows:
        """Return the positions (m, 2) in mm for features (m, inputs)."""
        return np.asarray(self._position_mm[self.correlate(features).argmax(axis=1)])

    def correlate(self, features: Rows) -> Rows:
        """Return the correlation peak with each recorded touch, shape (m, n); 1 for an equal signal."""
        white = self._whitened(features)
        peak = np.full((len(white), len(self._kept)), -np.inf, np.float32)
        for turn in self._turns:
            np.maximum(peak, ((white * turn) @ self._kept.conj().T).real, out=peak)
        return peak

    def _whitened(self, features: Rows) -> NDArray[np.complex64]:
        bins = complex_bins(features, self._channels).reshape(len(features), -1)
        white = bins / np.maximum(np.abs(bins), np.finfo(np.float32).tiny)
        return np.asarray(white / np.sqrt(white.shape[1]), np.complex64)
