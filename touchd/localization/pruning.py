"""Take fingers out of a fit that are none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

from msgspec.structs import replace

from touchd.localization.fit import Bins, Fit, shapes_of
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.missing import MissingFinger
from touchd.localization.noise import NoiseModel
from touchd.localization.pursuit import is_worth
from touchd.localization.spline import Position

_STEPS = 2

T = TypeVar("T")


class Pruning:
    """Fits the fingers of a fit again, without those that explain too little.

    Parameters
    ----------
    solver : GaussNewton
    noise : NoiseModel
    missing : MissingFinger
        Says whether fewer lack one.
    """

    def __init__(self, solver: GaussNewton, noise: NoiseModel, missing: MissingFinger) -> None:
        self._solver, self._noise, self._missing = solver, noise, missing

    def prune(self, bins: Bins, fit: Fit, signal: float) -> tuple[Fit, list[int]]:
        """Return a fit without the fingers that explain next to nothing, and the indices of those, as they go.

        Nor does a faint one explain anything if the plate's own movement explains it as well. Several go at once: all
        fingers of a hand may lift in one frame.
        """
        dropped: list[int] = []
        noise_energy, energies = self._noise.noise_energy, fit.energies
        while len(energies) > 1:
            least = min(energies)
            weak = CRITERIA.weak * max(fit.residual_energy - noise_energy, CRITERIA.enough * signal)
            if least <= weak:
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
        worth = is_worth(fit, fewer, self._noise.noise_energy, signal) or self._missing.is_worth(bins, fit, fewer)
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
