"""Noise model of the bins: power per bin, mask of dead channels and tones, directions of the plate's own movement."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.localization.atlas import Array, Atlas
from touchd.localization.fit import Bins, Fit
from touchd.localization.fit_criteria import CRITERIA

MEMORY_FRAMES = 256
DROWNED = 10.0
"""A bin with 10 times the noise power of most others holds an interfering tone and is masked."""
_MASK_FRAMES = 16
"""Untouched frames after which bins are masked."""
_OUTDATED = 1.1
"""The noise in use is another once it has more energy than was known, or less, by this factor."""
SIGNIFICANT = 80.0
"""Energy, in variances of a bin's part, that a fit must explain: at the best of a thousand positions white noise
explains some 15, and up to twice that where the window correlates neighbouring bins."""
_ALIKE_COSINE, _SOUND_NS = 0.4, 100_000_000
"""What fingers leave of two frames, at most so long apart, is noise below this cosine; what is another finger's is more
alike."""
ALIKE, COMPARED_FRAMES = 50.0, 32
"""White noise in n values has n shapes, or n / 3 where the window correlates neighbouring bins. Noise with fewer than
n / 50 shapes over 32 frames is coloured: tones and jitter have two to four (twin)."""


class BinPower:
    """Averages the power of each value over untouched frames.

    White noise would be known from the samples, but tones and trigger jitter have spectra of their own.

    Parameters
    ----------
    channels, bins : int
    dtype : type
    weights : array of shape (bins,), optional
        Of the bins.
    """

    def __init__(
        self, channels: int, bins: int, dtype: DTypeLike = np.float32, weights: NDArray[np.float64] | None = None
    ) -> None:
        self._shape = channels, 2, bins
        self._white = 1.0 if weights is None else weights**2
        self._frames = 0
        self.power: Array = np.zeros(channels * 2 * bins, dtype)
        """Of each value, counts squared."""
        self._square = np.zeros_like(self.power)
        self._weight = np.zeros((), dtype)

    def reset(self) -> None:
        """Forget all frames."""
        self.restart()
        self.power[:] = 0

    def restart(self) -> None:
        """Average from the next frame on; until then the present power stays in use."""
        self._frames = 0

    def update(self, bins: Array) -> bool:
        """Add an untouched frame, shape (channels * 2 * bins,); return whether `quiet` masks bins from now on."""
        self._frames = min(self._frames + 1, MEMORY_FRAMES)
        np.multiply(bins, bins, out=self._square)
        np.subtract(self._square, self.power, out=self._square)
        self._weight[...] = 1 / self._frames
        np.multiply(self._square, self._weight, out=self._square)
        np.add(self.power, self._square, out=self.power)
        return self._frames == _MASK_FRAMES

    @property
    def is_known(self) -> bool:
        """Whether `quiet` masks bins."""
        return self._frames >= _MASK_FRAMES

    def quiet(self) -> NDArray[np.bool_]:
        """Return which values do not drown in noise, shape (channels * 2 * bins,); all before 16 frames."""
        of_bins = self.power.reshape(self._shape).sum(axis=1, keepdims=True) / self._white
        usual = float(np.median(of_bins))
        if not self.is_known or usual <= 0:
            return np.ones(self.power.shape, bool)
        return np.repeat(of_bins < DROWNED * usual, 2, axis=1).reshape(-1)


class NoiseModel:
    """Knows the noise of each bin, and masks dead channels and bins that drown.

    Parameters
    ----------
    atlas : Atlas
    """

    channels: NDArray[np.bool_]
    """Channels in use, shape (channels,)."""
    mask: Array | None
    """0 for each value left out, 1 for the others, shape (size,); None if all are in use."""
    noise_energy: float
    """Mean noise energy of a frame, counts squared."""
    ceiling: float
    """Noise energy that one frame seldom exceeds: the mean and `noise_spread` of it, counts squared."""
    variance: float
    """Noise variance of a value, scaled to how far it moves a position, counts squared."""
    min_signal_energy: float
    """A fit, or a finger of several, that explains no more may be one of noise, counts squared."""
    active_bins: int
    """Values in use."""
    mean_error: float
    """Mean square of what the field misses in a channel and bin at amplitude 1."""

    def __init__(self, atlas: Atlas) -> None:
        d, dtype = atlas.description, atlas.coefficients.dtype
        self._bin_power = BinPower(d.acquisition.channels, len(d.bins), dtype, d.bin_weights)
        self._per_channel = 2 * len(d.bins)
        self._error, self._noise_scale = atlas.error, d.noise_scale
        self._energy = np.zeros((), dtype)
        self._last, self._before = np.zeros(atlas.size, dtype), np.zeros(atlas.size, dtype)
        self._left = np.zeros(atlas.size, dtype)  # by fingers of the last frame that sounded
        self._usual_energy, self._counted = 0.0, 1.0  # how many times the usual energy is counted with, ...
        self._louder, self._sounded_ns = 1.0, -_SOUND_NS  # ... and in the last frame that sounded, and when
        self.mask, self.noise_energy = None, 0.0
        self.reset()

    def reset(self) -> None:
        """Forget the noise."""
        self._bin_power.reset()
        self._alike, self._compared, self._last_energy = 0.0, 0, 0.0

    def restart(self, share: float) -> None:
        """Estimate the noise from the next frames on; until it is known it is this `share` of what it was."""
        self._bin_power.restart()
        self._bin_power.power *= share

    def update(self, bins: Array) -> bool:
        """Add the bins of an untouched frame; return whether noise or masked bins are others: call `set_channels`."""
        self._compare(bins)
        return self._bin_power.update(bins) or self._is_outdated()

    def set_channels(self, live: NDArray[np.bool_], directions: Array, quiet: NDArray[np.bool_] | None = None) -> None:
        """Use these channels, shape (channels,), without the bins that drown.

        Parameters
        ----------
        live : array of shape (channels,)
        directions : array of shape (k, size)
            Those in which the untouched plate can move, orthonormal.
        quiet : array of shape (size,), optional
            Values that hold no other interference.
        """
        if not live.any():
            live = np.ones_like(live)  # nothing can be said; what the frames hold decides
        self.channels = live
        values = np.repeat(live, self._per_channel) & self._bin_power.quiet()
        if quiet is not None and (values & quiet).any():
            values &= quiet
        dtype = self._energy.dtype
        self.mask = None if values.all() else values.astype(dtype)
        self.active_bins = max(int(values.sum()), 1)
        self._usual_energy = float(self._bin_power.power[values].sum())
        self._count(1.0)
        self.mean_error = float(self._error[live].mean())
        self._directions = directions
        if self.mask is not None:
            self._directions = np.linalg.qr((directions * values).T)[0].T.astype(dtype)  # orthonormal again
        self._along = np.zeros(len(self._directions), dtype)

    def listen(self, sounds: bool, t_ns: int) -> None:
        """Count with the noise of the last frame in which the plate sounded for one in which it `sounds`."""
        louder = self._louder if sounds and 0 <= t_ns - self._sounded_ns < _SOUND_NS else 1.0
        if louder != self._counted:
            self._count(louder)

    def hear(self, left: Array, t_ns: int) -> None:
        """Take what the fingers followed leave of a frame that sounds, shape (size,), for its noise.

        Not if it is like what they left of the last such frame: then it is another finger's.
        """
        energy, before = float(left @ left), float(self._left @ self._left)
        lately = 0 <= t_ns - self._sounded_ns < _SOUND_NS
        alike = lately and abs(float(left @ self._left)) > _ALIKE_COSINE * math.sqrt(energy * before)
        self._left[:] = left
        self._sounded_ns = t_ns
        silent = self._usual_energy <= 0
        self._louder = 1.0 if alike or silent else max(energy / self._usual_energy, 1.0)
        self._count(self._louder)

    def _count(self, louder: float) -> None:
        """Count with so many times the usual energy of noise."""
        self._counted = louder
        self.noise_energy = louder * self._usual_energy
        self.ceiling = (1 + CRITERIA.noise_spread) * self.noise_energy
        self.variance = self._noise_scale * self.noise_energy / self.active_bins
        self.min_signal_energy = SIGNIFICANT * self.noise_energy / self.active_bins

    @property
    def is_alike(self) -> bool:
        """Whether the noise has few shapes, as tones and trigger jitter have, so that a finger's may be among them."""
        return self._alike * self.active_bins > ALIKE

    def plate_energy(self, vector: Array) -> float:
        """Return the energy of bins, shape (size,), along the plate's own directions, counts squared."""
        self._directions.dot(vector, self._along)
        self._along.dot(self._along, self._energy)
        return self._energy.item()

    def without_plate(self, rows: Array) -> Array:
        """Return rows of bins, shape (k, size), without what lies along the plate's own directions."""
        return np.asarray(rows - (rows @ self._directions.T) @ self._directions)

    def excess(self, residual_energy: float, signal: float) -> float:
        """Return what a fit leaves beyond what noise may have, as a share of the signal's energy."""
        return (residual_energy - self.ceiling) / signal

    def judge(self, bins: Bins, fit: Fit) -> tuple[float, float, float]:
        """Return the signal's energy, the share of it that a fit leaves, and how much that looks like fingers, 0..1."""
        signal = bins.energy - self.noise_energy
        excess = self.excess(fit.residual_energy, signal)
        return signal, excess, CRITERIA.confidence(excess) if sum(fit.energies) > self.min_signal_energy else 0.0

    def _is_outdated(self) -> bool:
        """Return whether the noise has become another while nothing else called for `set_channels`."""
        power, known = self._bin_power.power, self._usual_energy
        if self.mask is None:
            np.add.reduce(power, out=self._energy)
        else:
            power.dot(self.mask, self._energy)
        return self._bin_power.is_known and not known <= _OUTDATED * self._energy.item() <= _OUTDATED**2 * known

    def _compare(self, bins: Array) -> None:
        """Average the squared cosine between successive noise frames: its mean is one over the number of shapes."""
        last, before = self._before, self._last
        np.copyto(last, bins)
        if self.mask is not None:
            np.multiply(last, self.mask, last)
        last.dot(last, self._energy)
        energy = self._energy.item()
        last.dot(before, self._energy)
        if energy > 0 and self._last_energy > 0:
            self._compared = min(self._compared + 1, COMPARED_FRAMES)
            cosine2 = self._energy.item() ** 2 / (energy * self._last_energy)
            self._alike += (cosine2 - self._alike) / self._compared
        self._last, self._before, self._last_energy = last, before, energy
