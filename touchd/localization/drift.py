"""Temperature and gains of the plate and its electronics, and the correction of bins for them.

The field atlas was learned at one temperature with one set of gains. The baseline follows the untouched plate and so
tells how far it has come from there; a frame's bins are corrected for that. While a finger rests on the plate the
baseline is frozen and the plate drifts on. `Drift` follows the few directions in which it can, with a time constant of
0.3 s, and subtracts what lies along them.

A disc and its bond age: gain and phase of a channel then tilt along the band, as the untouched plate shows, too. Cables
that run side by side bring the drive itself into the channels, unstretched, and more or less of it once somebody has
moved them, or has brought a hand near them. What may be drive tells nothing of the plate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.detection.drive_changes import along_band
from touchd.localization.atlas import Array, Atlas
from touchd.localization.plate_changes import delayed, drive_waves, plate_directions, stretched_dft

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]


class Expansion(NamedTuple):
    """What changes to first order about a stretch."""

    stretch: float
    known: Complex
    """Bins of the plate of the training after it, shape (channels, bins)."""
    by_stretch: Complex
    """Their derivative."""
    back: Floats
    """What takes samples to bins as they were before it, shape (samples, 2 * bins)."""
    back_slope: Floats
    """Its derivative."""


DEAD_BELOW = 0.05
"""A channel with less than this share of its energy in training is dead."""
FOLLOW_S = 0.3
"""Time constant of the correction under a finger: slow for noise, quick for a temperature."""
FOLLOW_EVERY_NS = 40_000_000
"""Least time between two updates of it."""
_ROUNDS, _MOST_ROUNDS = 3, 8
_SETTLED = 1e-6  # a smaller step ends a fit, 0.02 K on glass
_STEP = 2e-4  # of stretches for which bins are computed; about each the change is of first order
_KEPT = 6  # of those last used: a fit from 0 passes as many
_EXACT = 3e-3  # gains nearer to 1 are left as they are: that moves a finger by 1 um
_PLAUSIBLE_STRETCH = 3e-3  # seventy kelvin on glass, eleven on aluminium
_LARGEST_STRETCH = 3e-2  # thirty kelvin on acrylic; beyond the plausible it has to explain the untouched plate
_EXPLAINED = 0.3  # it leaves less than this share: twenty kelvin on acrylic leave 0.005, another plate 0.4 and more
_LARGEST_GAIN = 30.0  # or its inverse: an audio interface's knob was turned; another plate's gains are near 0


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
        self._description, self._weights = atlas.description, np.tile(atlas.description.bin_weights, 2)
        self._expansions: dict[float, Expansion] = {}
        self._waves = drive_waves(a)
        self._drive: Floats = np.linalg.qr((self._waves @ self._plain).T)[0].T
        """Orthonormal directions in which the drive can move a channel, shape (4, 2 * bins)."""
        self._reference = atlas.baseline.astype(np.float64)
        self._known = self._plate_energy(self._reference)
        self._omega_rad_s = 2 * np.pi * bins * a.sample_rate_hz / a.samples
        self._along_band = along_band(a, self._omega_rad_s / (2 * np.pi))
        self._channels, self._size = a.channels, atlas.size
        self.matrix: Array = self._plain.astype(self._dtype)
        """What takes samples to bins, shape (samples, 2 * bins)."""
        self._inverse: Array | None = None
        """What undoes the gains: each part's factors, and those of the other part, shape (2, channels, 2, bins)."""
        self._crossed: Array = np.zeros((a.channels, 2, len(bins)), self._dtype)
        self.directions: Array = np.zeros((0, self._size), self._dtype)
        """Orthonormal directions in which the untouched plate can move, shape (up to 2 + 5 * channels, size)."""
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
        self.gains: Complex = np.ones((a.channels, len(bins)), np.complex128)
        """Of each channel along the band, relative to training, shape (channels, bins)."""
        self.dead = np.zeros(a.channels, bool)
        """Channels without a signal."""
        self.signal_energy = 1.0
        """Of the untouched plate's bins, counts squared."""
        self.drive_changes = np.zeros((3, self._size))
        """What a delay, a rise and a slope of the drive add to the untouched plate's bins, shape (3, size)."""

    def set_baseline(self, baseline: Array) -> None:
        """Compare the untouched plate, (channels, samples), with the one in training."""
        live = baseline.astype(np.float64)
        self.dead = self._plate_energy(live) < DEAD_BELOW * self._known
        self.stretch, self.gains = self._fit(live)
        near = self._expanded(self.stretch)
        by = _inverse(self.stretch) - _inverse(near.stretch)
        self.matrix = (near.back + by * near.back_slope).astype(self._dtype)
        self._inverse = None
        if np.abs(self.gains - 1).max() > _EXACT:
            real, imaginary = (1 / self.gains).real, (1 / self.gains).imag
            inverse = np.stack([[real, real], [-imaginary, imaginary]]).swapaxes(1, 2)
            self._inverse = np.ascontiguousarray(inverse, self._dtype)
        self._set_directions(live, near.back_slope)
        self.reset()

    def correct(self, residual: Array, out: Array) -> None:
        """Write the corrected bins of a residual of shape (channels, samples) to `out`, of shape (size,)."""
        table = out.reshape(self._channels, -1)
        residual.dot(self.matrix, table)
        if self._inverse is not None:
            parts = out.reshape(self._crossed.shape)
            np.multiply(parts[:, ::-1], self._inverse[1], out=self._crossed)
            np.multiply(parts, self._inverse[0], out=parts)
            np.add(parts, self._crossed, out=parts)
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
        """Return the energy of each channel's bins without what may be the drive, shape (channels,)."""
        return np.asarray(np.square(self._without_drive(signal @ self._plain)).sum(axis=1))

    def _without_drive(self, bins: Floats) -> Floats:
        """Return bins (..., 2 * bins) without what may be the drive."""
        return np.asarray(bins - (bins @ self._drive.T) @ self._drive)

    def _fit(self, live: Floats) -> tuple[float, Complex]:
        """Return stretch and gains that lead from the untouched plate in training to the one now.

        A gain is linear along the band, in real and imaginary part: a delay is the slope of its phase. What was found
        before plays no part.
        """
        stretch, gains = 0.0, np.ones_like(self.gains)
        nothing = 0.0, np.ones_like(gains)
        alive = np.flatnonzero(~self.dead)
        if not alive.size:
            return nothing
        middle, half = np.mean(self._omega_rad_s), np.ptp(self._omega_rad_s) / 2 or 1.0
        along, left = (self._omega_rad_s - middle) / half, math.inf
        now = _to_complex(live @ self._plain)[alive]
        for k in range(_MOST_ROUNDS):
            near = self._expanded(stretch)
            stretched = near.by_stretch[alive]
            expected = near.known[alive] + (stretch - near.stretch) * stretched
            each = np.stack([expected, 1j * expected, along * expected, 1j * along * expected], axis=1)
            columns = np.zeros((1 + 4 * len(alive), len(alive), 2 * len(along)))
            columns[0] = _to_parts(gains[alive] * stretched)
            for channel, own in enumerate(_to_parts(each)):
                columns[1 + 4 * channel : 5 + 4 * channel, channel] = own
            error = self._without_drive(_to_parts(now - gains[alive] * expected)).ravel()
            system = self._without_drive(columns).reshape(len(columns), -1).T
            found = np.linalg.lstsq(system, error, rcond=1e-9)[0]
            left = float(np.square(error - system @ found).sum())
            stretch += float(found[0])
            c = found[1:].reshape(-1, 4, 1)
            gains[alive] += c[:, 0] + 1j * c[:, 1] + along * (c[:, 2] + 1j * c[:, 3])
            if not abs(stretch) < _LARGEST_STRETCH or (k + 1 >= _ROUNDS and abs(found[0]) < _SETTLED):
                break
        explained = left < _EXPLAINED * np.square(self._without_drive(_to_parts(now))).sum()
        known_by = _LARGEST_STRETCH if explained else _PLAUSIBLE_STRETCH
        size = np.abs(gains)
        sound = abs(stretch) < known_by and 1 / _LARGEST_GAIN < size.min() <= size.max() < _LARGEST_GAIN
        return (stretch, gains) if sound else nothing

    def _expanded(self, stretch: float) -> Expansion:
        """Return the expansion about a stretch nearby."""
        about = _STEP * round(stretch / _STEP)
        found = self._expansions.pop(about, None)
        if found is None:
            d, bins = self._description, np.array(self._description.bins)
            forth = stretched_dft(d.acquisition, bins, about, d.taper)
            back = stretched_dft(d.acquisition, bins, _inverse(about), d.taper) if about else forth
            known, by_stretch = (_to_complex(self._reference @ (self._weights * each)) for each in forth)
            found = Expansion(about, known, by_stretch, *(self._weights * each for each in back))
        self._expansions = dict([*self._expansions.items()][1 - _KEPT :]) | {about: found}
        return found

    def _set_directions(self, live: Floats, slope: Floats) -> None:
        """Set the directions in which the untouched plate can move."""
        bins, stretched = (_to_parts(_to_complex(each) / self.gains) for each in (live @ self.matrix, live @ slope))
        self.signal_energy = max(float(np.square(bins).sum()), 1.0)
        bins[self.dead] = stretched[self.dead] = 0.0
        delay, along = delayed(bins, self._omega_rad_s), np.tile(self._along_band, 2)
        self.drive_changes = np.stack([delay, bins, along * bins]).reshape(3, -1)
        drive = _to_parts(_to_complex(self._waves @ self.matrix) / self.gains[:, None])
        directions = plate_directions(bins, stretched, self._omega_rad_s, drive)
        self.directions = directions.astype(self._dtype)
        self._along = np.zeros(len(directions), self._dtype)
        self._step = np.zeros_like(self._along)


def _inverse(stretch: float) -> float:
    """Return the stretch that undoes another one."""
    return -stretch / (1 + stretch)


def _to_complex(bins: Floats) -> Complex:
    """Return bins (..., 2 b), real parts and then imaginary ones, as complex numbers (..., b)."""
    real, imaginary = np.split(bins, 2, axis=-1)
    return np.asarray(real + 1j * imaginary)


def _to_parts(bins: Complex) -> Floats:
    """Return complex bins (..., b) as `_to_complex` takes them."""
    return np.concatenate([bins.real, bins.imag], axis=-1)
