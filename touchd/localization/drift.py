"""What the plate and its electronics do to a frame by themselves: warmth, gains, and what comes with time.

The field atlas was learned at one temperature with one set of gains. The untouched plate, which the baseline
follows, tells how far it has come from there, and a frame's bins are corrected for that. While a finger
rests on the plate the baseline stands still and the plate drifts on: the few directions in which it can are
followed too, and what lies along them is taken off the frame.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Array, Atlas
from touchd.localization.features import windowed_dft
from touchd.localization.thermal import stretch_matrix

DEAD_BELOW = 0.05
"""A channel with less than this share of the energy that it had in training is dead."""
FOLLOW_S = 0.3
"""Time constant at which drift under a finger is followed: slow for noise, quick for a temperature."""
_ROUNDS = 2  # the stretch is fitted in its first order
_LARGEST_STRETCH = 3e-3  # some seventy kelvin: beyond it the first order says nothing, and the cause is another
_LARGEST_GAIN = 1.0


class Drift:
    """Turns residuals into the bins of an atlas as they would be on the plate that it was learned on.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        a, bins = atlas.description.acquisition, np.array(atlas.description.bins)
        self._plain = windowed_dft(a, bins)
        self._stretched = stretch_matrix(a, bins)
        self._reference = atlas.baseline.astype(np.float64)
        self._omega_rad_s = 2 * np.pi * bins * a.sample_rate_hz / a.samples
        self._channels, self._size = a.channels, atlas.size
        self._matrix = self._plain.astype(np.float32)
        self._scale: Array | None = None
        self._directions = np.zeros((0, self._size), np.float32)
        self._along = np.zeros(0, np.float32)
        self._step = np.zeros(0, np.float32)
        self._drifted = np.zeros(self._size, np.float32)
        self._weight = np.zeros((), np.float32)
        self._moved = False
        self.stretch = 0.0
        """Relative rise of the plate's resonances since training; -4.5e-5 a kelvin on glass."""
        self.gains = np.ones(a.channels)
        """Of each channel, relative to training."""
        self.dead = np.zeros(a.channels, bool)
        """Channels that hear next to nothing."""
        self.signal_energy = 1.0
        """Of the untouched plate's bins, counts squared."""

    def rebase(self, baseline: Array) -> None:
        """Take note of the untouched plate as it is now, of shape (channels, samples)."""
        live = baseline.astype(np.float64)
        energy, known = np.square(live).sum(axis=1), np.square(self._reference).sum(axis=1)
        self.dead = energy < DEAD_BELOW * known
        self.stretch, self.gains = self._fit(live)
        self._matrix = (self._plain - self.stretch * self._stretched).astype(np.float32)
        self._scale = None
        if np.abs(self.gains - 1).max() > 1e-3:
            self._scale = (1 / self.gains).astype(np.float32)[:, None]
        self._set_directions(live)
        self.settle()

    def features(self, residual: Array, out: Array) -> None:
        """Write the corrected bins of a residual of shape (channels, samples) to `out`, of shape (size,)."""
        table = out.reshape(self._channels, -1)
        residual.dot(self._matrix, table)
        if self._scale is not None:
            np.multiply(table, self._scale, out=table)
        if self._moved:
            np.subtract(out, self._drifted, out)

    def follow(self, left: Array, elapsed_s: float) -> None:
        """Take in what the fingers do not explain of a frame's bins, shape (size,), so long after the last one."""
        if len(self._directions):
            np.dot(self._directions, left, out=self._step)
            self._weight[...] = 1 - math.exp(-elapsed_s / FOLLOW_S)
            np.multiply(self._step, self._weight, out=self._step)
            np.add(self._along, self._step, out=self._along)
            np.dot(self._along, self._directions, out=self._drifted)
            self._moved = True

    @property
    def directions(self) -> Array:
        """Orthonormal directions in which the untouched plate can move, shape (up to 2 + channels, size)."""
        return self._directions

    def settle(self) -> None:
        """Forget what has drifted under a finger: the baseline follows the plate again."""
        self._along[:] = 0
        self._moved = False

    def silent(self, residual: Array, baseline: Array) -> NDArray[np.bool_]:
        """Return which channels, shape (channels,), hear next to nothing in a frame of this residual."""
        energy = np.square(residual + baseline).sum(axis=1)
        return np.asarray(energy < DEAD_BELOW * np.square(self._reference).sum(axis=1))

    def _fit(self, live: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Return stretch and gains that lead from the untouched plate in training to the one now."""
        gains, stretch = np.ones(self._channels), 0.0
        alive = ~self.dead
        if not alive.any():
            return stretch, gains
        for _ in range(_ROUNDS):
            expected = self._reference @ self._plain + stretch * (self._reference @ self._stretched)
            slope = gains[:, None] * (self._reference @ self._stretched)
            error = live @ self._plain - gains[:, None] * expected
            columns = [slope, gains[:, None] * self._delayed(expected)]
            columns += [np.where(np.arange(self._channels)[:, None] == r, expected, 0.0) for r in np.flatnonzero(alive)]
            system = np.stack([column[alive].ravel() for column in columns], axis=1)
            found = np.linalg.lstsq(system, error[alive].ravel(), rcond=1e-9)[0]
            stretch += float(found[0])
            gains[alive] += found[2:]
        sound = abs(stretch) < _LARGEST_STRETCH and np.abs(gains - 1).max() < _LARGEST_GAIN
        return (stretch, gains) if sound else (0.0, np.ones(self._channels))

    def _set_directions(self, live: NDArray[np.float64]) -> None:
        """Set the orthonormal directions in which the untouched plate can move: stretch, delay, and each gain."""
        bins = live @ self._matrix
        if self._scale is not None:
            bins = bins * self._scale
        self.signal_energy = max(float(np.square(bins).sum()), 1.0)
        rows = [live @ self._stretched, self._delayed(bins)]
        rows += [np.where(np.arange(self._channels)[:, None] == r, bins, 0.0) for r in np.flatnonzero(~self.dead)]
        table = np.stack([row.ravel() for row in rows])
        norm = np.linalg.norm(table, axis=1, keepdims=True)
        if not (norm > 0).all():
            table = np.zeros((0, self._size))  # a rig that hears nothing
            norm = np.ones((0, 1))
        self._directions = np.linalg.qr((table / norm).T)[0].T.astype(np.float32)
        self._along = np.zeros(len(self._directions), np.float32)
        self._step = np.zeros_like(self._along)

    def _delayed(self, bins: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what a delay of a second adds to bins (channels, 2 * bins) in first order: -i omega times them."""
        count = len(self._omega_rad_s)
        return np.concatenate([self._omega_rad_s * bins[:, count:], -self._omega_rad_s * bins[:, :count]], axis=1)
