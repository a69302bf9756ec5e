"""Look for a finger that the others' shapes make up for.

Four fingers with five amplitudes each explain all but 1 % of what five do; the model misses as much of five. But what
it misses is alike for all receivers of a bin, and what a missing finger leaves is not. So the weighted fit can tell
(twin):

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

from touchd.localization.contact_field import Shape
from touchd.localization.contact_model import TYPICAL
from touchd.localization.fit import REST_COST, SCAN_COST, SHAPE_COST, Bins, Fit, Steps, no_fit, shapes_of
from touchd.localization.noise import NoiseModel
from touchd.localization.pursuit import MOST_FINGERS, Pursuit, are_merged
from touchd.localization.spline import Position
from touchd.localization.weighted_fit import WeightedFit

LARGE = 0.25
"""Misfit from which a finger may be missing."""
WORTH = 0.5
"""With a missing finger the misfit is less than this share of what it was."""
_STEPS = 2


class MissingFinger:
    """Looks for a finger that a fit of several with shapes lacks.

    Parameters
    ----------
    pursuit : Pursuit
    weighted : WeightedFit
    noise : NoiseModel
    """

    def __init__(self, pursuit: Pursuit, weighted: WeightedFit, noise: NoiseModel) -> None:
        self._pursuit, self._weighted, self._noise = pursuit, weighted, noise

    def steps(self, bins: Bins, fit: Fit) -> Steps[Fit]:
        """Return a fit with the fingers that it lacks, piece by piece; one that is at no finger goes for them."""
        if len(fit.shapes) < 2 or not (misfit := self.misfit(bins, fit)) > LARGE:
            return fit
        yield SHAPE_COST * _STEPS * len(fit.positions_mm)
        best, least = fit, misfit
        if len(fit.positions_mm) > 2:
            fewer = yield from self._shaped(bins, *_without_faintest(fit))
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
        shaped = yield from solver.shape_pieces(bins, start, self._noise.noise_energy, 1.0)
        yield SHAPE_COST * _STEPS * len(positions_mm)  # of the misfit that is asked next
        return shaped

    def is_worth(self, bins: Bins, fit: Fit, fewer: Fit) -> bool:
        """Return whether a fit explains so much more than one of fewer fingers that these lack one."""
        return bool(fewer.shapes) and self.misfit(bins, fit) < WORTH * self.misfit(bins, fewer)

    def misfit(self, bins: Bins, fit: Fit) -> float:
        """Return what a fit leaves, in variances that it may; infinite if it has no shapes."""
        return self._weighted.misfit(bins, fit, self._noise.variance) if fit.shapes else math.inf


def _without_faintest(fit: Fit) -> tuple[list[Position], list[Shape]]:
    """Return the places and shapes of a fit's fingers, but for the faintest one."""
    places, shapes = list(fit.positions_mm), shapes_of(fit)
    k = fit.energies.index(min(fit.energies))
    del places[k], shapes[k]
    return places, shapes
