"""Temperature, gains and delay of the plate and its electronics, and the correction of bins for them.

The field atlas was learned at one temperature with one set of gains. The baseline follows the untouched plate and so
tells how far it has come from there; a frame's bins are corrected for that. While a finger rests on the plate the
baseline is frozen and the plate drifts on. `Drift` follows the few directions in which it can, with a time constant of
0.3 s, and subtracts what lies along them.

A plate that warms gets slower, by the same share at every frequency: what it answered to an impulse at t it now answers
at t (1 - s). The chirp that it is struck with stays as it was. So the part of the signal about the frequency f, emitted
at the time tau(f), is stretched about tau(f) and not about the start of the frame.

Cables that run side by side bring the drive itself into the channels, unstretched, and more or less of it once somebody
has laid them anew. What may be drive tells nothing of the plate.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from touchd.frame import HANN, Acquisition
from touchd.localization.atlas import Array, Atlas

Floats = NDArray[np.float64]

DEAD_BELOW = 0.05
"""A channel with less than this share of its energy in training is dead."""
FOLLOW_S = 0.3
"""Time constant of the correction under a finger: slow for noise, quick for a temperature."""
FOLLOW_EVERY_NS = 40_000_000
"""Least time between two updates of it."""
_ROUNDS = 2  # the stretch is fitted to first order
_LARGEST_STRETCH = 3e-3  # some seventy kelvin: beyond it the first order is wrong, and so is the cause
_LARGEST_GAIN = 30.0  # or its inverse: an audio interface's knob was turned; another plate's gains are near 0
_LEAD = 0.1
"""Share of the period by which a bin's answer, sharp in frequency, begins before its frequency is emitted."""


class Drift:
    """Turns residuals into bins as they would be on the plate that the atlas was learned on.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        a, bins = atlas.description.acquisition, np.array(atlas.description.bins)
        self._dtype = atlas.coefficients.dtype
        self._plain = atlas.description.to_bins
        self._stretched = stretch_matrix(a, bins, atlas.description.taper) * np.tile(atlas.description.bin_weights, 2)
        drive = np.linalg.qr((drive_waves(a) @ self._plain).T)[0].T
        self._drive: Floats = drive
        """Orthonormal directions in which the drive can move a channel, shape (4, 2 * bins)."""
        self._reference = atlas.baseline.astype(np.float64)
        self._known = self._plate_energy(self._reference)
        self._omega_rad_s = 2 * np.pi * bins * a.sample_rate_hz / a.samples
        self._channels, self._size = a.channels, atlas.size
        self.matrix: Array = self._plain.astype(self._dtype)
        """What takes samples to bins, shape (samples, 2 * bins)."""
        self._scale: Array | None = None
        self.directions: Array = np.zeros((0, self._size), self._dtype)
        """Orthonormal directions in which the untouched plate can move, shape (up to 2 + channels, size)."""
        self._along = np.zeros(0, self._dtype)
        self._step = np.zeros(0, self._dtype)
        self._drifted = np.zeros(self._size, self._dtype)
        self._weight = np.zeros((), self._dtype)
        self._moved = False
        self.energy = 0.0
        """Of what is subtracted, counts squared."""
        self.t_ns: int | None = None
        """Time of the last update, or of the first frame with a finger."""
        self.stretch = 0.0
        """Relative rise of the plate's resonances since training; -4.5e-5 a kelvin on glass."""
        self.gains = np.ones(a.channels)
        """Of each channel, relative to training."""
        self.dead = np.zeros(a.channels, bool)
        """Channels without a signal."""
        self.signal_energy = 1.0
        """Of the untouched plate's bins, counts squared."""
        self.delay = np.zeros(self._size)
        """What a delay of a second adds to the untouched plate's bins, shape (size,)."""

    def set_baseline(self, baseline: Array) -> None:
        """Compare the untouched plate, (channels, samples), with the one in training."""
        live = baseline.astype(np.float64)
        self.dead = self._plate_energy(live) < DEAD_BELOW * self._known
        self.stretch, self.gains = self._fit(live)
        self.matrix = (self._plain - self.stretch * self._stretched).astype(self._dtype)
        self._scale = None
        if np.abs(self.gains - 1).max() > 1e-3:
            self._scale = (1 / self.gains).astype(self._dtype)[:, None]
        self._set_directions(live)
        self.reset()

    def correct(self, residual: Array, out: Array) -> None:
        """Write the corrected bins of a residual of shape (channels, samples) to `out`, of shape (size,)."""
        table = out.reshape(self._channels, -1)
        residual.dot(self.matrix, table)
        if self._scale is not None:
            np.multiply(table, self._scale, out=table)
        if self._moved:
            np.subtract(out, self._drifted, out)

    def is_due(self, t_ns: int) -> bool:
        """Return whether an update is due at a time. A first frame starts the clock: in no time nothing drifts."""
        if self.t_ns is None:
            self.t_ns = t_ns
        return not 0 <= t_ns - self.t_ns <= FOLLOW_EVERY_NS

    def update(self, unexplained: Array, t_ns: int) -> None:
        """Follow the drift by what the fingers leave of a frame's bins, shape (size,)."""
        elapsed_s = 0.0 if self.t_ns is None else max(t_ns - self.t_ns, 0) * 1e-9
        self._add(unexplained, t_ns, 1 - math.exp(-elapsed_s / FOLLOW_S))

    def absorb(self, bins: Array, t_ns: int) -> None:
        """Follow the drift at once by a frame's bins without a finger, shape (size,)."""
        self._add(bins, t_ns, 1.0)

    def _add(self, vector: Array, t_ns: int, weight: float) -> None:
        """Add this share of what lies along the directions."""
        self.t_ns = t_ns
        if not len(self.directions) or weight <= 0:
            return
        np.dot(self.directions, vector, out=self._step)
        self._weight[...] = weight
        np.multiply(self._step, self._weight, out=self._step)
        np.add(self._along, self._step, out=self._along)
        np.dot(self._along, self.directions, out=self._drifted)
        self._along.dot(self._along, self._weight)
        self.energy = self._weight.item()
        self._moved = True

    def reset(self) -> None:
        """Forget the drift under a finger: the baseline follows the plate again."""
        self._along[:] = 0
        self.energy = 0.0
        self._moved = False
        self.t_ns = None

    def silent(self, residual: Array, baseline: Array) -> NDArray[np.bool_]:
        """Return which channels, shape (channels,), are without a signal in a frame of this residual."""
        return np.asarray(self._plate_energy(residual + baseline) < DEAD_BELOW * self._known)

    def _plate_energy(self, signal: Array | Floats) -> Floats:
        """Return the energy of what each channel's bins hold beside what may be the drive, shape (channels,)."""
        bins = signal @ self._plain
        return np.asarray(np.square(bins - (bins @ self._drive.T) @ self._drive).sum(axis=1))

    def _fit(self, live: Floats) -> tuple[float, Floats]:
        """Return stretch and gains that lead from the untouched plate in training to the one now."""
        gains, stretch = np.ones(self._channels), 0.0
        alive = ~self.dead
        if not alive.any():
            return stretch, gains
        size = np.linalg.norm(self._reference @ self._plain)
        for _ in range(_ROUNDS):
            expected = self._reference @ self._plain + stretch * (self._reference @ self._stretched)
            slope = gains[:, None] * (self._reference @ self._stretched)
            error = live @ self._plain - gains[:, None] * expected
            columns = [slope, gains[:, None] * delayed(expected, self._omega_rad_s)]
            each = [np.arange(self._channels)[:, None] == r for r in np.flatnonzero(alive)]
            columns += [np.where(own, expected, 0.0) for own in each]
            columns += [np.where(own, size * wave, 0.0) for own in each for wave in self._drive]
            system = np.stack([column[alive].ravel() for column in columns], axis=1)
            found = np.linalg.lstsq(system, error[alive].ravel(), rcond=1e-9)[0]
            stretch += float(found[0])
            gains[alive] += found[2 : 2 + len(each)]
        sound = abs(stretch) < _LARGEST_STRETCH and 1 / _LARGEST_GAIN < gains.min() <= gains.max() < _LARGEST_GAIN
        return (stretch, gains) if sound else (0.0, np.ones(self._channels))

    def _set_directions(self, live: Floats) -> None:
        """Set the directions in which the untouched plate can move."""
        bins, stretched = live @ self.matrix, live @ self._stretched
        if self._scale is not None:
            bins, stretched = bins * self._scale, stretched * self._scale
        self.signal_energy = max(float(np.square(bins).sum()), 1.0)
        bins[self.dead] = stretched[self.dead] = 0.0
        self.delay = delayed(bins, self._omega_rad_s).ravel()
        directions = plate_directions(bins, stretched, self._omega_rad_s)
        self.directions = directions.astype(self._dtype)
        self._along = np.zeros(len(directions), self._dtype)
        self._step = np.zeros_like(self._along)


def drive_waves(acquisition: Acquisition) -> Floats:
    """Return the waves that a channel may hear of the drive, shape (4, samples).

    The chirp and what a capacitance makes of it, its derivative, and both a quarter of a wave later, for filters.
    """
    chirp, t_s = acquisition.chirp, np.arange(acquisition.samples) / acquisition.sample_rate_hz
    rate = (chirp.stop_hz - chirp.start_hz) / chirp.duration_s
    phase, f = 2 * np.pi * (chirp.start_hz + rate * t_s / 2) * t_s, (chirp.start_hz + rate * t_s) / chirp.stop_hz
    return np.asarray(
        (t_s < chirp.duration_s) * np.stack([np.sin(phase), f * np.cos(phase), np.cos(phase), f * np.sin(phase)])
    )


def emission_s(acquisition: Acquisition, bins: NDArray[np.int64]) -> Floats:
    """Return when the linear chirp passes the frequency of each bin, s after the frame's start, shape (bins,)."""
    chirp = acquisition.chirp
    f_hz = np.asarray(bins) * acquisition.sample_rate_hz / acquisition.samples
    return np.asarray((f_hz - chirp.start_hz) / (chirp.stop_hz - chirp.start_hz) * chirp.duration_s)


def stretch_matrix(acquisition: Acquisition, bins: NDArray[np.int64], taper: float = HANN) -> Floats:
    """Return the matrix from samples to the derivative of the windowed bins by a stretch of the plate's response.

    A signal y of shape (..., samples) whose plate has become slower or faster since has the features
    y @ windowed_dft + s * (y @ stretch_matrix): s is the relative rise of all its resonances' frequencies, -4.5e-5 a
    kelvin for the twin's glass.

    Parameters
    ----------
    acquisition : Acquisition
    bins : array of int, shape (b,)
        Indices of the DFT bins.
    taper : float
        Of their window.

    Returns
    -------
    array of float64, shape (samples, 2 * b)
        Columns as `touchd.localization.features.windowed_dft` orders them: real parts, then imaginary parts.
    """
    n, rate_hz = acquisition.samples, acquisition.sample_rate_hz
    bins = np.asarray(bins)
    # The features are a sum over samples of the derivative y'(t) times t - tau(f), window and phase. The index product
    # is reduced modulo the length first: cos of a large argument loses digits.
    phase = (np.outer(np.arange(n), bins) % n) * (2 * np.pi / n)
    later_s = np.arange(n)[:, None] / rate_hz - emission_s(acquisition, bins)
    period_s = acquisition.chirp.period_s
    if period_s is not None:  # what comes before the chirp's own answer is the ringing of the one before
        later_s = (later_s + _LEAD * period_s) % period_s - _LEAD * period_s
    weight = acquisition.window(taper)[:, None] * later_s
    # y' is that of the band-limited signal, a product with i omega: the transpose of that step, applied to the weights.
    slope = 2j * np.pi * np.fft.rfftfreq(n, 1 / rate_hz)
    if n % 2 == 0:
        slope[-1] = 0.0  # the alternating signal has no slope at its samples

    def derived(columns: Floats) -> Floats:
        return np.asarray(np.fft.irfft(-slope[:, None] * np.fft.rfft(columns, axis=0), n, axis=0))

    return np.concatenate([derived(weight * np.cos(phase)), derived(-weight * np.sin(phase))], axis=1)


def delayed(bins: Floats, omega_rad_s: Floats) -> Floats:
    """Return what a delay of a second adds to bins (channels, 2 * bins) in first order: -i omega times them."""
    count = len(omega_rad_s)
    return np.concatenate([omega_rad_s * bins[:, count:], -omega_rad_s * bins[:, :count]], axis=1)


def plate_directions(bins: Floats, stretched: Floats, omega_rad_s: Floats) -> Floats:
    """Return the orthonormal directions in which the untouched plate can move: stretch, delay, and each gain.

    Parameters
    ----------
    bins : array of shape (channels, 2 * bins)
        Of the untouched plate; zero in dead channels.
    stretched : array of the same shape
        Their derivative by a stretch.
    omega_rad_s : array of shape (bins,)

    Returns
    -------
    array of shape (up to 2 + channels, channels * 2 * bins), without rows on a rig that hears nothing.
    """
    rows = [stretched, delayed(bins, omega_rad_s)]
    rows += [np.where(np.arange(len(bins))[:, None] == r, bins, 0.0) for r in np.flatnonzero(bins.any(axis=1))]
    table = np.stack([row.ravel() for row in rows])
    norm = np.linalg.norm(table, axis=1, keepdims=True)
    if not (norm > 0).all():
        return np.zeros((0, bins.size))
    return np.asarray(np.linalg.qr((table / norm).T)[0].T)
