"""The untouched plate: learned at the start, followed as it drifts, frozen while touched."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.config.schema import BaselineSettings
from touchd.detection.drive_changes import drive_changes
from touchd.detection.hum import BELOW, Hum
from touchd.detection.quiet_frames import LEAST_WINDOWS, SOON_WINDOWS, QuietFrames
from touchd.frame import Acquisition, Counts

Signal = NDArray[np.floating]
"""An array of the pipeline's floating-point type, float32 unless a test asks for float64."""

# Bound once: they run for every frame.
_subtract, _multiply, _add = np.subtract, np.multiply, np.add
_LONGEST_STEP_S = 0.1
"""The baseline moves by at most this much time at once: after a gap it must not swallow a single frame whole."""
_LEAST_SHARE = 1 / 512
"""The mean moves by at least this share of the residual, in every n-th frame where its time constant is long. Of a
count float32 holds no smaller part at full scale: a mean that is moved by less stands still."""
_QUICKLY = 8
"""Movement that is known to be the plate's own is followed this many times as fast: the next touch may come soon."""
_LOUD, _LEAST_CALM = 2.0, 0.01
"""Noise of more than this much of the energy that it had when the mean was learned moves the mean the less, so that the
mean is as good as it was; but a plate that warms is still followed in a minute."""
_USED_TO_S = 10.0
"""What stays loud becomes the usual: e times as much in this time."""
_STEADY_RATIO = 0.7
_PATIENCE_WINDOWS = 20
"""A plate that is never steady, and shows nothing between touches, is learned as it is after this many windows: a poor
baseline is better than none."""
_FAR = 0.9
"""Share of the ADC's range: no finger changes the untouched signal by as much as a tenth of it."""


class Baseline:
    """The mean untouched frame, in ADC counts.

    While it learns, it keeps frames until a whole window of them is steady, so that a plate that is being touched, or
    has just been switched on, is not taken for an untouched one.

    Parameters
    ----------
    acquisition : Acquisition
        Of the frames.
    settings : BaselineSettings
    dtype : type
        Of all arrays.
    """

    def __init__(self, acquisition: Acquisition, settings: BaselineSettings, dtype: DTypeLike = np.float32) -> None:
        shape, self._acquisition = acquisition.shape, acquisition
        self.hum = Hum(acquisition, dtype)
        """What is taken out of every residual once there is any."""
        self.sound = Hum(acquisition, dtype, BELOW)
        """The same of sound that goes on, as of a loudspeaker, up to higher frequencies."""
        # In steady state a filter takes it out of what is captured: `touchd.audio.capture`.
        self._may_sound = acquisition.chirp.period_s is None
        self.mean: Signal = np.zeros(shape, dtype)
        self.signal: Signal = np.zeros(shape, dtype)
        """The last frame, as floats; valid until the next frame."""
        self.residual: Signal = np.zeros(shape, dtype)
        """The last frame less the mean; valid until the next frame."""
        self._flat = self.residual.reshape(-1)
        self._whole = self.residual
        """What the mean follows: the residual, or a copy from before something was taken out of it."""
        self._copy = np.zeros(shape, dtype)
        self._step = np.zeros(shape, dtype)
        self._weight = np.zeros((), dtype)
        self._energy = np.zeros((), dtype)
        self._drive: Signal | None = None
        self.drive_energy = 0.0
        """Energy of the residual that is the drive's own change, see `drive_changes`; 0 unless there is any."""
        self._silenced: list[int] = []
        self._t_ns = 0
        self._elapsed_ns = 0
        self.configure(settings)
        self._patience = _PATIENCE_WINDOWS * settings.learn_frames
        self._window: Signal = np.zeros((settings.learn_frames, *shape), dtype)
        self.window = self._window
        """The frames learned from, shape (n, channels, samples)."""
        self._begin()
        self._kept: Signal | None = None
        self._calm_energy = self._noise_energy = 0.0  # of noise: when the mean was learned, and now

    def configure(self, settings: BaselineSettings) -> None:
        """Follow the plate with another time constant."""
        self._time_constant_s = settings.time_constant_s
        self._weighed_ns = -1  # the step for which `_weight` and `_every` hold
        self._every, self._waited = 1, 0

    def reset(self, *, keep_mean: bool = False) -> None:
        """Begin to learn with the next frame; until the `end` of learning `mean` stays as it is.

        To `keep_mean` is to learn the noise alone: of loud noise the mean over a window is a poor one, and wrong once
        the noise has gone.
        """
        self._kept = self.mean.copy() if keep_mean else None
        self._begin()

    def _begin(self) -> None:
        self._filled = self._tried = 0
        self._quiet = QuietFrames()

    def set_channels(self, live: NDArray[np.bool_]) -> None:
        """Have no residual, and so no drift, in channels that are not live, shape (channels,)."""
        self._silenced = np.flatnonzero(~live).tolist()

    def learn(self, counts: Counts | Signal, t_ns: int) -> NDArray[np.float64] | None:
        """Take one frame into the window.

        Returns
        -------
        ndarray of shape (learn_frames,) or None
            The residual energies of the window's frames once the baseline is known; None before.
        """
        self._t_ns = t_ns
        self.signal[...] = counts
        self._window[self._filled] = counts
        self._filled += 1
        self._tried += 1
        frames = self._window
        if self._filled < len(frames):
            return None
        np.mean(frames, axis=0, out=self.mean)
        residuals = frames - self.mean
        if self.hum.learn(residuals):
            frames = self.mean + residuals
        energies, self.sound.known = _energies(residuals), False
        if not _steady(residuals, energies) and self.learn_sound(residuals):
            frames, energies = self.mean + residuals, _energies(residuals)
        drive = None if _steady(residuals, energies) else drive_changes(self._acquisition, self.mean, residuals)
        if drive is not None:  # a level that ripples by the mains may be as slow, from frame to frame, as a finger
            flat = residuals.reshape(len(residuals), -1)
            residuals = (flat - flat @ drive.T @ drive).reshape(residuals.shape)
            energies = _energies(residuals)
        if not _steady(residuals, energies):
            self._quiet.add(frames)
            waits = self._tried < self._patience
            quiet = self._quiet.latest(len(frames), SOON_WINDOWS if waits else LEAST_WINDOWS)
            if quiet is None and waits:
                half = len(frames) // 2
                self._window[: len(frames) - half] = self._window[half:].copy()
                self._filled = len(frames) - half
                return None
            frames = frames if quiet is None else quiet
        self._begin()
        return self.learn_from(frames)

    def learn_from(self, frames: Signal) -> NDArray[np.float64]:
        """Take frames of the untouched plate, shape (n, channels, samples), as those to learn from.

        Returns
        -------
        ndarray of shape (n,)
            Their residual energies.
        """
        self.window = frames
        np.mean(frames, axis=0, out=self.mean)
        residuals = self.learned()
        found = drive_changes(self._acquisition, self.mean, residuals)
        # A trigger that has jittered still does, also where louder noise hides it.
        self._drive, self.drive_energy = self._drive if found is None else found, 0.0
        return _energies(residuals, self._drive)

    def learn_sound(self, residuals: Signal) -> bool:
        """Look for sound in untouched frames, (n, channels, samples); remove it, in place, and return whether any is.

        Tones are none: they are looked for before, but where sound is so unsteady that nothing else can be told.
        """
        return self.awaits_sound and self.sound.learn(residuals)

    @property
    def awaits_sound(self) -> bool:
        """Whether there may be sound that is not taken out yet."""
        return self._may_sound and not self.sound.known

    def take_out_sound(self) -> None:
        """Take out sound from the next frame on: it has begun since the plate was learned."""
        self.sound.known = True
        if self._drive is not None:
            rows = self._drive.reshape(-1, *self.mean.shape).copy()
            for row in rows:
                self.sound.remove(row)
            self._drive = np.linalg.qr(rows.reshape(len(rows), -1).T)[0].T.astype(rows.dtype)

    def learned(self) -> Signal:
        """Return the residuals of the frames learned from, shape (up to learn_frames, channels, samples)."""
        return np.asarray(self.window - self.mean)

    def end(self, noise_energy: float) -> Signal:
        """End to learn, of noise of this energy, and return what `learned` does."""
        residuals = self.learned()
        if self._kept is None:
            self._calm_energy = noise_energy
        else:
            self.mean[...] = self._kept
            self._kept = None
        return residuals

    def subtract(self, counts: Counts, t_ns: int) -> float:
        """Put the frame less the mean into `residual`, and return the latter's `residual_energy` (counts squared)."""
        self._elapsed_ns = t_ns - self._t_ns
        self._t_ns = t_ns
        self._whole = self.residual
        # One conversion, then floats alone: to mix them in one call takes twice as long, and memory each time.
        self.signal[...] = counts
        _subtract(self.signal, self.mean, self.residual)
        if self.sound.known:
            self.sound.remove(self.residual)
        elif self.hum.known:
            self.hum.remove(self.residual)
        for channel in self._silenced:
            self.residual[channel] = 0
        return self.residual_energy()

    def keep(self) -> None:
        """Keep the residual as it is for the mean to follow, whatever is taken out of it next."""
        self._copy[...] = self.residual
        self._whole = self._copy

    def residual_energy(self) -> float:
        """Return the energy of `residual` but for the drive's own changes, if there are any; counts squared."""
        self._flat.dot(self._flat, self._energy)
        energy: float = self._energy.item()
        if self._drive is not None:
            along = self._drive @ self._flat
            self.drive_energy = float(along @ along)
            energy = max(energy - self.drive_energy, 0.0)
        return energy

    def clips(self, top: float) -> bool:
        """Return whether the last frame reaches the end of the ADC's range, `top`, far from where the mean is."""
        return bool(np.logical_and(np.abs(self.signal) >= top, np.abs(self.mean) < _FAR * top).any())

    def energy(self) -> float:
        """Return the energy of the untouched signal, counts squared; at least 1, since a dead DAQ sends zeros."""
        flat = self.mean.reshape(-1)
        return max(float(flat.dot(flat)), 1.0)

    def shift(self, change: Signal) -> None:
        """Move the mean by a change, shape (channels, samples)."""
        _add(self.mean, change, self.mean)

    def follow(self, noise_energy: float, *, quickly: bool = False) -> None:
        """Move the mean towards the last frame, by the time since the frame before it, and the slower the louder."""
        if quickly or self._elapsed_ns != self._weighed_ns:
            elapsed_ns = self._elapsed_ns * (_QUICKLY if quickly else 1)
            self._weighed_ns = elapsed_ns
            elapsed_s = min(max(elapsed_ns * 1e-9, 0.0), _LONGEST_STEP_S)
            share = elapsed_s / (self._time_constant_s + elapsed_s)
            self._every = math.ceil(_LEAST_SHARE / share) if 0 < share < _LEAST_SHARE else 1
            elapsed_s *= self._every
            self._weight.fill(elapsed_s / (self._time_constant_s + elapsed_s))
        calm = self._calm(noise_energy)
        self._waited += 1
        if self._waited < self._every:
            return
        self._waited = 0
        _multiply(self._whole, self._weight if calm == 1 else calm * self._weight, self._step)
        _add(self.mean, self._step, self.mean)

    def _calm(self, noise_energy: float) -> float:
        """Return the share of its usual pace at which the mean follows, by how loud the noise has become."""
        if noise_energy < max(self._calm_energy, self._noise_energy / _LOUD):
            self._calm_energy = noise_energy  # what was loud has gone: the rest of it is in the mean
        self._noise_energy = noise_energy
        if noise_energy <= _LOUD * self._calm_energy:
            return 1.0
        grown = 1 + min(max(self._elapsed_ns * 1e-9, 0.0), _LONGEST_STEP_S) / _USED_TO_S
        self._calm_energy = max(grown * self._calm_energy, _LEAST_CALM * noise_energy)
        return self._calm_energy / noise_energy


def _energies(residuals: Signal, drive: Signal | None = None) -> NDArray[np.float64]:
    """Return the energies of residuals, (n, channels, samples), against their own mean, without the drive's changes."""
    flat = residuals.reshape(len(residuals), -1)
    energies: NDArray[np.float64] = np.einsum("ij,ij->i", flat, flat, dtype=np.float64)
    if drive is not None:
        energies -= np.square(flat @ drive.T).sum(axis=1)
    # The mean was taken from these very frames, which makes their residuals too small by 1/n.
    energies *= len(flat) / (len(flat) - 1)
    return energies


def _steady(residuals: Signal, energies: NDArray[np.float64]) -> bool:
    """Return whether successive frames differ as much as frames far apart: neither drift nor touch between them.

    The ratio of von Neumann (Ann. Math. Stat. 12:367, 1941): about 1 for noise that is independent from frame to
    frame, near 0 for anything slow.
    """
    successive = np.diff(residuals.reshape(len(residuals), -1), axis=0)
    noise = 0.5 * np.einsum("ij,ij->i", successive, successive, dtype=np.float64).mean()
    return bool(noise >= _STEADY_RATIO * energies.mean())
