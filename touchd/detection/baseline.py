"""The untouched plate: learned at the start, followed as it drifts, frozen while touched."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import BaselineSettings
from touchd.frame import Counts

Signal = NDArray[np.float32]

# Bound once: they run for every frame.
_subtract, _multiply, _add = np.subtract, np.multiply, np.add
_STEADY_RATIO = 0.7
# A plate that is never still is learned as it is after so many windows: better a poor baseline than silence.
_PATIENCE_WINDOWS = 20


class Baseline:
    """The mean untouched frame of shape (channels, samples), in ADC counts.

    While it is being learned, frames are kept until a whole window of them is steady: a plate that is
    being touched, or has just been switched on, is not taken for an untouched one.
    """

    def __init__(self, shape: tuple[int, int], settings: BaselineSettings) -> None:
        self.mean: Signal = np.zeros(shape, np.float32)
        self.signal: Signal = np.zeros(shape, np.float32)
        """The last frame itself, as floats; valid until the next frame, as is what follows."""
        self.residual: Signal = np.zeros(shape, np.float32)
        """The last frame less the baseline."""
        self._flat = self.residual.reshape(-1)
        self._step = np.zeros(shape, np.float32)
        self._weight = np.zeros((), np.float32)
        self._energy = np.zeros((), np.float32)
        self._left_out: list[int] = []
        self.retune(settings)
        self._patience = _PATIENCE_WINDOWS * settings.learn_frames
        self.window: Signal = np.zeros((settings.learn_frames, *shape), np.float32)
        """The frames that it was learned from last, shape (learn_frames, channels, samples)."""
        self._filled = 0
        self._tried = 0

    def retune(self, settings: BaselineSettings) -> None:
        """Follow the plate with another time constant."""
        self._time_constant_s = settings.time_constant_s
        self._weighed_s = math.nan  # of what time `_weight` is

    def learn(self, counts: Counts) -> NDArray[np.float64] | None:
        """Take in one frame while learning.

        Returns
        -------
        ndarray of shape (learn_frames,) or None
            The residual energies of the frames learned from once the baseline is known, None before.
        """
        self.signal[...] = counts
        self.window[self._filled] = counts
        self._filled += 1
        self._tried += 1
        if self._filled < len(self.window):
            return None
        frames = self.window
        np.mean(frames, axis=0, out=self.mean)
        residuals = (frames - self.mean).reshape(len(frames), -1)
        energies: NDArray[np.float64] = np.einsum("ij,ij->i", residuals, residuals, dtype=np.float64)
        # The mean was taken from these very frames, which makes their residuals too small by 1/n.
        energies *= len(frames) / (len(frames) - 1)
        if not _steady(residuals, energies) and self._tried < self._patience:
            half = len(frames) // 2
            frames[: len(frames) - half] = frames[half:].copy()
            self._filled = len(frames) - half
            return None
        self.restart()
        return energies

    def restart(self) -> None:
        """Begin learning afresh with the next frame; until then `mean` stays as it is."""
        self._filled = 0
        self._tried = 0

    def subtract(self, counts: Counts) -> float:
        """Put the frame less the baseline into `residual`, and return its energy (counts squared)."""
        # One conversion, then floats alone: to mix them in one call takes twice as long, and memory each time.
        self.signal[...] = counts
        _subtract(self.signal, self.mean, self.residual)
        for channel in self._left_out:
            self.residual[channel] = 0
        self._flat.dot(self._flat, self._energy)
        return self._energy.item()

    def leave_out(self, channels: NDArray[np.bool_]) -> None:
        """Have no residual, and so no drift, in some channels, shape (channels,), until others are named."""
        self._left_out = np.flatnonzero(channels).tolist()

    def energy(self) -> float:
        """Return the energy of the untouched signal itself (counts squared)."""
        flat = self.mean.reshape(-1)
        return float(flat.dot(flat))

    def follow(self, elapsed_s: float) -> None:
        """Move the baseline towards the last frame, which was untouched and came this long after the one before."""
        if elapsed_s != self._weighed_s:
            self._weighed_s = elapsed_s
            self._weight.fill(elapsed_s / (self._time_constant_s + elapsed_s))
        _multiply(self.residual, self._weight, self._step)
        _add(self.mean, self._step, self.mean)


def _steady(residuals: Signal, energies: NDArray[np.float64]) -> bool:
    """Return whether successive frames differ as much as frames far apart: no drift and no touch in between.

    This is the ratio of von Neumann (Ann. Math. Stat. 12:367, 1941), about 1 for noise that is
    independent from frame to frame and near 0 for anything slow.
    """
    successive = np.diff(residuals, axis=0)
    noise = 0.5 * np.einsum("ij,ij->i", successive, successive, dtype=np.float64).mean()
    return bool(noise >= _STEADY_RATIO * energies.mean())
