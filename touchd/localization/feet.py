"""Feet and pads that nothing glues: a finger presses the plate on them, and they change the signal as fingers would.

A foot that couples more adds to the bins what a contact of its own place and width does, so the field atlas knows it
but for an amplitude. All feet answer at once: beside a light or gloved finger, which presses hard for what it is heard,
they are most of the change (twin). Their places have to be known; then `take_out` fits fingers to what feet do not
explain, and gives back to fingers what looked like feet, in turn. Of light fingers more are looked for at once, as a
search in the whole frame would find the feet.

A contact on a foot alone stays a finger, as its own fit leaves nothing to ask the feet for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from touchd.detection.detection import Detection
from touchd.localization.atlas import Array, Atlas
from touchd.localization.fit import Bins, Fit
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.following import FOLLOW_STEPS, Follower
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.landing import Landing
from touchd.localization.noise import NoiseModel
from touchd.localization.nuisance import refit
from touchd.localization.pursuit import MOST_FINGERS, Pursuit
from touchd.localization.spline import Position, Spline

RADIUS_MM = 4.5
"""Of a foot, over which its field is the mean: feet are 8 to 10 mm wide, and points of the mean err little."""
MOST_SIZE = 1.0
"""No foot has a larger amplitude, nor a light finger: one of a pane of 0.5 kg has up to 0.4, a bare finger 2 or more
(twin)."""
NEAR_MM = 6.0
"""A light contact this near to a foot, beside others, is the foot's: it is seen up to 5 mm off (twin)."""
ROUNDS, ENOUGH = 6, 1.0
"""Most rounds; one that would move the bins by less than this, in deviations of a value's noise, is not worth a fit."""
LEAST = 1e-2
"""Directions that show less than this share of the clearest one are not told from noise."""
BETTER = 0.5
"""Feet are believed if fingers then leave less than this share of what they leave without."""
_RING = [(0.0, 0.0), *((RADIUS_MM * 0.7 * np.cos(a), RADIUS_MM * 0.7 * np.sin(a)) for a in np.arange(6) * np.pi / 3)]


class Feet:
    """Takes the feet's part out of a frame's bins.

    Parameters
    ----------
    atlas : Atlas
    solver : GaussNewton
    noise : NoiseModel
    landing : Landing
    follower : Follower
        Both fit fingers to what feet leave.
    pursuit : Pursuit
        Names places for another one.
    """

    def __init__(
        self, atlas: Atlas, solver: GaussNewton, noise: NoiseModel, landing: Landing, follower: Follower,
        pursuit: Pursuit,
    ) -> None:  # fmt: skip
        self._solver, self._noise, self._landing, self._follower = solver, noise, landing, follower
        self._pursuit = pursuit
        d, dtype = atlas.description, atlas.coefficients.dtype
        self._parts = 2, d.acquisition.channels, len(d.bins)
        self._field: Array = np.zeros((3, atlas.size), dtype)
        self._spline = Spline(atlas, self._field)
        self._fields: Array = np.zeros((0, atlas.size), dtype)  # what each foot adds, by the parts of its amplitude
        self._places_mm: Sequence[Position] = ()
        self._mask: Array | None = None
        self._set_mask(None)

    def set_places(self, places_mm: Sequence[Position]) -> bool:
        """Take the places of all feet, and return whether they are others than before."""
        if places_mm == self._places_mm:
            return False
        self._places_mm = places_mm
        spline, rows = self._spline, []
        for x_mm, y_mm in places_mm:
            total = np.zeros_like(self._field[0])
            for dx_mm, dy_mm in _RING:
                spline.at(*spline.inside(x_mm + dx_mm, y_mm + dy_mm))
                total += self._field[0] / len(_RING)
            real, imaginary = total.reshape(self._parts)
            rows += [np.stack(pair, axis=1).reshape(-1) for pair in ((real, imaginary), (-imaginary, real))]
        self._fields = np.array(rows, total.dtype) if rows else self._fields[:0]
        self._set_mask(None)
        return True

    def take_out(self, detection: Detection, bins: Bins, fit: Fit, *, tracked: bool) -> tuple[Bins, Fit] | None:
        """Return bins without the feet's part, and the fingers in them; None unless they leave far less than a fit."""
        if not self._places_mm:
            return None
        if bins.mask is not self._mask:
            self._set_mask(bins.mask)
        noise_energy = self._noise.noise_energy
        left = self._less(bins, np.zeros(len(self._rows), bins.vector.dtype))
        if tracked:
            found = self._follower.follow(left, detection.t_ns, left.energy - noise_energy)
        else:
            found = self._landing.fit(detection, left, left.energy - noise_energy, anywhere=True)
        left, found = self._settle(bins, left, found)
        while self._lacks(left, found):
            places_mm = self._pursuit.candidates(self._solver.residual(left, found), 1)
            several = self._solver.fit_several(left, [*found.positions_mm, *places_mm], FOLLOW_STEPS)
            more = self._settle(bins, left, several)
            if more[1].residual_energy - noise_energy > CRITERIA.worth * (found.residual_energy - noise_energy):
                break
            left, found = more
        if not (found.positions_mm and self._explains(bins, left, found)):
            return None
        if found.residual_energy - noise_energy > BETTER * (fit.residual_energy - noise_energy):
            return None
        self._follower.drop()
        return left, found

    def _less(self, bins: Bins, own: Array) -> Bins:
        """Return bins without the feet's part, of which `own` along the feet is the fingers'."""
        vector = bins.vector - (self._rows @ bins.vector - own) @ self._rows
        return Bins(vector, bins.mask, float(vector @ vector))

    def _settle(self, bins: Bins, left: Bins, found: Fit) -> tuple[Bins, Fit]:
        """Give fingers back what looked like feet, and fit them again, in turn."""
        own = np.zeros(len(self._rows), bins.vector.dtype)
        for _ in range(ROUNDS if found.positions_mm else 0):
            step = self._rows @ (left.vector - self._solver.residual(left, found)) - own
            own = own + step
            if float(step @ step) < ENOUGH**2 * self._noise.variance:
                break
            left = self._less(bins, own)
            found = refit(left, found, self._solver, self._noise.noise_energy)
        return left, found

    def _lacks(self, left: Bins, found: Fit) -> bool:
        """Return whether light fingers lack another one; heavy ones are fitted without the feet."""
        excess = self._noise.excess(found.residual_energy, left.energy - self._noise.noise_energy)
        return 0 < len(found.positions_mm) < MOST_FINGERS and excess > CRITERIA.fair and _is_light(found)

    def _explains(self, bins: Bins, left: Bins, found: Fit) -> bool:
        """Return whether no foot is too strong for one, and fingers are light or leave little."""
        excess = self._noise.excess(found.residual_energy, left.energy - self._noise.noise_energy)
        feet = self._to_amplitudes @ (self._rows @ (bins.vector - left.vector))
        small = bool((np.square(feet.reshape(-1, 2)).sum(axis=1) < MOST_SIZE**2).all())
        return small and (excess < CRITERIA.fair or _is_light(found))

    def among(self, fit: Fit, sizes: list[float]) -> set[int]:
        """Return which of several contacts, of amplitudes of these moduli, are feet."""
        return {
            k for k, place in enumerate(fit.positions_mm)
            if sizes[k] < MOST_SIZE and any(math.dist(place, foot) < NEAR_MM for foot in self._places_mm)
        }  # fmt: skip

    def _set_mask(self, mask: Array | None) -> None:
        self._mask = mask
        fields = self._fields if mask is None else self._fields * mask
        across, size, rows = np.linalg.svd(fields, full_matrices=False)
        apart = size > LEAST * size.max(initial=0.0)  # feet that were named twice are one
        self._rows = np.ascontiguousarray(rows[apart])
        self._to_amplitudes = across[:, apart] / size[apart]


def _is_light(fit: Fit) -> bool:
    return max(map(abs, fit.amplitudes)) < MOST_SIZE
