"""Fingers that a fit lacks, and fingers of it that are none.

Shapes of some fingers make up for a missing one. Four fingers with five amplitudes each explain all but 1 % of what
five do; the model misses as much of five. But what it misses is alike for all receivers of a bin, and what a missing
finger leaves is not. So the weighted fit can tell (twin):

| misfit | says |
|---|---|
| 0.1 to 0.3, of one fit in ten more | two to five fingers are all there |
| 0.3 to 1.5 | a finger is missing |
| with another finger, 0.1 to 0.47 of what it was | that was the missing one |
| with another finger, 0.59 of it or more | there is no finger |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

from msgspec.structs import replace

from touchd.localization.contact_model import TYPICAL
from touchd.localization.fit import REST_COST, SCAN_COST, SHAPE_COST, Bins, Fit, Steps, no_fit, shapes_of
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.noise import NoiseModel
from touchd.localization.pursuit import MOST_FINGERS, Pursuit, are_merged, is_worth
from touchd.localization.spline import Position, Shape
from touchd.localization.weighted_fit import WeightedFit

LARGE = 0.25
"""Misfit from which a finger may be missing."""
WORTH = 0.5
"""With a missing finger the misfit is less than this share of what it was."""
_STEPS = 2

T = TypeVar("T")


class FingerCount:
    """Looks for a finger that a fit of several with shapes lacks, and takes out those that explain too little.

    Parameters
    ----------
    solver : GaussNewton
    pursuit : Pursuit
    noise : NoiseModel
    weighted : WeightedFit
    """

    def __init__(self, solver: GaussNewton, pursuit: Pursuit, noise: NoiseModel, weighted: WeightedFit) -> None:
        self._solver, self._pursuit, self._noise, self._weighted = solver, pursuit, noise, weighted

    def with_missing(self, bins: Bins, fit: Fit) -> Steps[Fit]:
        """Return a fit with the fingers that it lacks, piece by piece; one that is at no finger goes for them."""
        if len(fit.shapes) < 2 or not (misfit := self.misfit(bins, fit)) > LARGE:
            return fit
        yield SHAPE_COST * _STEPS * len(fit.positions_mm)
        best, least = fit, misfit
        if len(fit.positions_mm) > 2:
            faintest = fit.energies.index(min(fit.energies))
            places, shapes = _without(fit.positions_mm, faintest), _without(shapes_of(fit), faintest)
            fewer = yield from self._shaped(bins, places, shapes)
            left = self.misfit(bins, fewer)
            if misfit > WORTH * left:
                fit, misfit = fewer, left
        while len(fit.positions_mm) < MOST_FINGERS:
            more = yield from self._one_more(bins, fit)
            left = self.misfit(bins, more)
            if not left < WORTH * misfit:
                break
            fit, misfit = more, left
        return fit if misfit < WORTH * least else best

    def _one_more(self, bins: Bins, fit: Fit) -> Steps[Fit]:
        """Return a fit with another finger: the best of some that the scan names."""
        solver, shapes = self._pursuit.solver, [*shapes_of(fit), TYPICAL]
        candidates = self._pursuit.candidates(solver.residual(bins, fit))
        yield REST_COST + SCAN_COST
        starts = []
        for candidate_mm in candidates:
            starts.append(solver.fit_several(bins, [*fit.positions_mm, candidate_mm], 1, shapes=shapes))
            yield 2.0 * len(shapes)
        starts.sort(key=lambda one: one.residual_energy)
        if not starts:
            return no_fit(bins.energy)
        more = yield from self._shaped(bins, starts[0].positions_mm, shapes)
        return no_fit(bins.energy) if are_merged(more) else more

    def _shaped(self, bins: Bins, positions_mm: Sequence[Position], shapes: Sequence[Shape]) -> Steps[Fit]:
        solver = self._pursuit.solver
        start = solver.fit_several(bins, positions_mm, _STEPS, shapes=shapes)
        yield float(len(positions_mm) * (_STEPS + 1))
        shaped = yield from solver.shape_pieces(bins, start, self._noise.noise_energy, lacking=True)
        yield SHAPE_COST * _STEPS * len(positions_mm)  # of the misfit that is asked next
        return shaped

    def is_worth(self, bins: Bins, fit: Fit, fewer: Fit) -> bool:
        """Return whether a fit explains so much more than one of fewer fingers that these lack one."""
        return bool(fewer.shapes) and self.misfit(bins, fit) < WORTH * self.misfit(bins, fewer)

    def misfit(self, bins: Bins, fit: Fit) -> float:
        """Return what a fit leaves, in variances that it may; infinite if it has no shapes."""
        return self._weighted.misfit(bins, fit, self._noise.variance) if fit.shapes else math.inf

    def prune(self, bins: Bins, fit: Fit, signal: float) -> tuple[Fit, list[int]]:
        """Return a fit without the fingers that explain next to nothing, and the indices of those, as they go.

        One of two where there is room for one explains part of the other. Nor does a faint one explain anything if the
        plate's own movement explains it as well. Several go at once: all fingers of a hand may lift in one frame.
        """
        dropped: list[int] = []
        noise_energy, energies = self._noise.noise_energy, fit.energies
        while len(energies) > 1:
            least = min(energies)
            weak = CRITERIA.weak * max(fit.residual_energy - noise_energy, CRITERIA.enough * signal)
            if fit.shapes and are_merged(fit, followed=True):
                gone = [energies.index(least)]
            elif least <= weak:
                most = max(energies)
                gone = [k for k, energy in enumerate(energies) if energy <= weak and energy < most]
            elif least < CRITERIA.faint * noise_energy:
                weakest = energies.index(least)
                gone = [weakest] if self._moved_energy(bins, fit, weakest) < fit.residual_energy else []
            else:
                break
            if not gone:
                break
            places = fit.positions_mm
            for k in reversed(gone):
                dropped.append(k)
                places = _without(places, k)
            fit = self._fit(bins, places)
            energies = fit.energies
        return fit, dropped

    def needed(self, bins: Bins, fit: Fit, signal: float) -> Fit:
        """Return a fit without fingers that the plate's own movement explains, nor one that the others do without."""
        return self._without_needless(bins, self._without_movement(bins, fit), signal)

    def again(self, bins: Bins, positions_mm: list[Position], found: Fit) -> Fit:
        """Fit contacts found in an earlier frame from positions nearby, with the shapes that they had or new ones."""
        if not found.shapes:
            return self._fit(bins, positions_mm)
        as_found = self._solver.fit_known(bins, positions_mm, _STEPS, shapes_of(found))
        shaped = self._solver.fit_shapes(bins, as_found, self._noise.noise_energy, _STEPS)
        grown = sum(as_found.energies) / max(sum(found.energies), 1e-30)
        return replace(shaped if shaped.positions_mm else as_found, points_energy=grown * found.points_energy)

    def _without_movement(self, bins: Bins, fit: Fit) -> Fit:
        """Return a fit without further fingers that the plate's own movement explains nearly as well."""
        noise_energy = self._noise.noise_energy
        for k in range(len(fit.positions_mm) - 1, -1, -1):
            if len(fit.positions_mm) < 2:
                break
            most = max(fit.residual_energy - noise_energy, 0.0) / CRITERIA.worth + 1.25 * noise_energy
            if self._moved_energy(bins, fit, k) < most:
                fit = self._fit(bins, _without(fit.positions_mm, k))
        return fit

    def _without_needless(self, bins: Bins, fit: Fit, signal: float) -> Fit:
        """Return a fit without its faintest finger if the others need none: from elsewhere their shapes were wrong."""
        least = min(fit.energies, default=math.inf)
        if len(fit.positions_mm) < 2 or not fit.shapes or least > CRITERIA.fair * signal:
            return fit
        k = fit.energies.index(least)
        amplitudes, energies, shapes = (_without(values, k) for values in (fit.amplitudes, fit.energies, fit.shapes))
        kept = replace(fit, amplitudes=amplitudes, energies=energies, shapes=shapes)
        fewer = self.again(bins, _without(fit.positions_mm, k), kept)
        worth = is_worth(fit, fewer, self._noise.noise_energy, signal) or self.is_worth(bins, fit, fewer)
        return fit if worth else fewer

    def _moved_energy(self, bins: Bins, fit: Fit, k: int) -> float:
        """Return what a fit leaves if the plate's own movement takes the place of finger `k`, counts squared."""
        left = self._solver.residual(bins, fit, without=k)
        return float(left @ left) - self._noise.plate_energy(left)

    def _fit(self, bins: Bins, positions_mm: list[Position]) -> Fit:
        """Fit contacts of unknown shape from positions nearby."""
        fit = self._solver.fit_several(bins, positions_mm, _STEPS)
        return self._solver.with_shapes(bins, fit, self._noise.noise_energy)


def _without(values: Sequence[T], k: int) -> list[T]:
    """Return all values but the one at index `k`; none of none."""
    return [*values[:k], *values[k + 1 :]]
