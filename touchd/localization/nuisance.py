"""What is in a frame besides fingers and white noise, in known directions: changes of the drive, hit samples.

A trigger that comes late adds the time derivative of the untouched signal, a louder drive the signal itself, which may
slope along the band; a blanked sample may have had any value. The amounts s are unknown in each frame. `remove` takes
out the frame's whole part in these directions Q, and with it some of the fingers'. Once fingers are fitted, `settle`
puts theirs back and fits again: alternating least squares for the amounts and the fingers. It converges within two
rounds unless a finger looks like a delay, as one on the emitter does; Aitken's step helps there. How much the drive
changes, the untouched frames tell; each change is shrunk accordingly, and left alone where it is below noise.
"""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from touchd.detection.impulses import WIDTH
from touchd.localization.atlas import Array
from touchd.localization.fit import Bins, Fit
from touchd.localization.gauss_newton import GaussNewton

ACTIVE = 16.0
"""Power along a change of the drive, over that of noise, from which it is removed: 0.5 ns of jitter at 60 dB."""
MEMORY_FRAMES = 256
ROUNDS = 4
"""Most rounds of `settle`; still touches take one or two."""
ENOUGH = 1.0
"""A round that would move the bins by less than this, in deviations of a value's noise, is not worth a fit."""
STEPS = 3
FINGERS_SHARE = 0.005
"""Share of their energy that fingers have along each: five fingertips up to 0.05, one near the emitter more."""
_FASTEST = 0.9
"""Largest ratio of successive rounds that Aitken's step extrapolates."""
_WEAK = 1e-3
"""Combinations of hit samples that show less than this in the bins are not told from noise."""


class Nuisance:
    """Removes the drive's changes and hit samples from bins, and gives fingers back what is theirs.

    Parameters
    ----------
    size : int
        Of the bins, channels * 2 * bins.
    dtype : type
    """

    active: NDArray[np.bool_]
    """Whether the drive changes in each way by more than noise hides, shape (3,): late, louder, sloping."""

    def __init__(self, size: int, dtype: np.dtype[np.floating]) -> None:
        self._drive: Array = np.zeros((3, size), dtype)  # orthonormal
        self._keep = np.zeros(0, dtype)  # share of each direction that is removed
        self._directions: Array = np.zeros((0, size), dtype)
        self._returned: Array = np.zeros(0, dtype)
        self._followed = np.zeros(3, dtype)  # the fingers' own part along the drive's changes in the last frame
        self._settled = np.zeros(3, dtype)  # what was left along them then
        self._energy, self._along = np.zeros((), dtype), np.zeros(3, dtype)
        self.reset()

    @property
    def engaged(self) -> bool:
        """Whether the next frame has a change of the drive to remove, or the last one had hit samples."""
        return self._changes or len(self._directions) > 0

    def set_drive(self, changes: Array, mask: Array | None) -> None:
        """Take what a delay, a rise and a slope of the drive add to the untouched bins, any length, (3, size)."""
        rows = changes if mask is None else changes * mask
        norm = np.linalg.norm(rows, axis=1, keepdims=True)
        rows = np.linalg.qr((rows / norm).T)[0].T if (norm > 0).all() else np.zeros_like(rows)
        self._drive = rows.astype(self._drive.dtype)

    def reset(self) -> None:
        """Forget how much the drive changes."""
        self._power, self._last, self._white, self._frames = [0.0] * 3, [0.0] * 3, 0.0, 0
        self._set_active([False] * 3)

    def forget_fingers(self) -> None:
        """Expect no finger in the next frame."""
        if self._changes:
            self._followed[:] = 0.0

    def learn(self, vector: Array) -> None:
        """Update how the drive changes by the bins of an untouched frame."""
        np.dot(self._drive, vector, out=self._along)
        along = self._along.tolist()
        vector.dot(vector, self._energy)
        self._frames = min(self._frames + 1, MEMORY_FRAMES)
        white = (self._energy.item() - sum(each * each for each in along)) / len(vector)
        if self._frames > 1:
            for k, (each, last) in enumerate(zip(along, self._last, strict=True)):
                # Against the last frame: a plate that warms moves this way too, but slowly.
                self._power[k] += ((each - last) ** 2 / 2 - self._power[k]) / (self._frames - 1)
        self._last = along
        self._white += (white - self._white) / self._frames
        found = [power > ACTIVE * self._white > 0 for power in self._power]
        if found != self.active.tolist():
            self._set_active(found)

    def hear(self, vector: Array) -> None:
        """Update the drive's changes by the bins of an untouched frame; if there are any, take them out of them."""
        self.learn(vector)
        if self._changes:
            vector -= (self._along * self.active) @ self._drive

    def _set_active(self, found: list[bool]) -> None:
        self.active, self._changes = np.array(found), any(found)
        self._followed[:] = 0.0

    def remove(self, vector: Array, runs: list[Array], mask: Array | None) -> None:
        """Take the drive's changes and hit samples out of the bins of a frame, in place.

        Parameters
        ----------
        vector : array of shape (size,)
        runs : list of arrays of shape (k, size)
            What each hit run of samples can add to the bins.
        mask : array of shape (size,), optional
        """
        drive = self._drive[self.active]
        self._directions = drive
        power = np.array(self._power)[self.active]
        self._keep = (1 - self._white / np.maximum(power, 1e-30)).astype(vector.dtype)
        if runs:
            table = np.concatenate(runs) if mask is None else np.concatenate(runs) * mask
            table = table - (table @ drive.T) @ drive
            _, size, rows = np.linalg.svd(table, full_matrices=False)
            rows = rows[size > _WEAK * size[0]].astype(vector.dtype)
            self._directions = np.concatenate([drive, rows])
            self._keep = np.concatenate([self._keep, np.ones(len(rows), vector.dtype)])
        if not len(self._directions):
            return
        self._returned = np.zeros_like(self._keep)
        if len(drive):
            followed = self._followed[self.active]
            self._returned[: len(drive)] = followed if followed.any() else self._expected(vector, drive, power)
        vector -= (self._keep * (self._directions @ vector) - self._returned) @ self._directions

    def _expected(self, vector: Array, drive: Array, power: NDArray[np.float64]) -> Array:
        """Return the part along the drive's changes that is the fingers' if nothing is known of them."""
        along = drive @ vector
        # What lies along them may be the drive's alone, and says nothing of fingers.
        own = FINGERS_SHARE * max(float(vector @ vector) - float(along @ along), 0.0)
        return np.asarray(self._keep[: len(drive)] * along * (own / (own + power)), vector.dtype)

    def settle(self, bins: Bins, fit: Fit, solver: GaussNewton, noise_energy: float) -> tuple[Bins, Fit]:
        """Return bins in which the fingers are whole, and their fit.

        Parameters
        ----------
        bins : Bins
            Whose vector `remove` has changed; it is changed again.
        fit : Fit
        solver : GaussNewton
        noise_energy : float
            Mean noise energy of the bins, counts squared.
        """
        if not len(self._directions) or not fit.positions_mm:
            return bins, fit
        before: NDArray[np.floating] | None = None
        enough = ENOUGH**2 * min(self._white, noise_energy / len(bins.vector))
        for _ in range(ROUNDS):
            explained = self._directions @ (bins.vector - solver.residual(bins, fit))
            step = self._keep * explained - self._returned
            size = float(step @ step)
            if size <= enough:
                break
            ratio = 0.0 if before is None else float(step @ before) / float(before @ before)
            before = step
            step = step / (1 - min(max(ratio, 0.0), _FASTEST))
            self._returned = self._returned + step
            vector = bins.vector
            vector += step @ self._directions
            vector.dot(vector, self._energy)
            bins = Bins(vector, bins.mask, self._energy.item())
            fit = refit(bins, fit, solver, noise_energy)
        if self._changes:
            self._followed[self.active] = self._returned[: int(self.active.sum())]
            np.dot(self._drive, bins.vector, out=self._settled)
        return bins, fit

    def align(self, vector: Array) -> None:
        """Give the bins of a frame, in place, the drive of the frame settled last: they can then be compared."""
        if self._changes:
            vector += ((self._settled - self._drive @ vector) * self.active) @ self._drive


def refit(bins: Bins, fit: Fit, solver: GaussNewton, noise_energy: float) -> Fit:
    """Fit the fingers of a fit to other bins of the same frame."""
    positions = fit.positions_mm
    if fit.shapes:
        shaped = solver.fit_shapes(bins, fit, noise_energy, STEPS)
        if shaped.positions_mm:
            return replace(shaped, points_energy=fit.points_energy)
    return (
        solver.fit_one(bins, *positions[0], STEPS)
        if len(positions) == 1
        else (solver.fit_several(bins, positions, STEPS))
    )


def hit_rows(matrix: Array, starts: tuple[int, ...], channels: int) -> list[Array]:
    """Return what runs of `WIDTH` hit samples can add to the bins: for each run and channel, rows of shape (k, size).

    Parameters
    ----------
    matrix : array of shape (samples, 2 * bins)
        From samples to bins.
    starts : tuple of int
        First sample of each run.
    channels : int
    """
    rows = []
    whole = float(np.linalg.norm(matrix, axis=1).max())
    for start in starts:
        _, size, shapes = np.linalg.svd(matrix[start : start + WIDTH], full_matrices=False)
        shapes = shapes[size > _WEAK * whole]
        for channel in range(channels):
            run = np.zeros((len(shapes), channels, matrix.shape[1]), matrix.dtype)
            run[:, channel] = shapes
            rows.append(run.reshape(len(shapes), -1))
    return rows
