"""Touch-down: where the one finger is that has just landed, and whether a frame tells that at all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter

from touchd.detection.detection import Detection
from touchd.localization.atlas import AtlasDescription
from touchd.localization.contact_model import elongation, oval_mm2
from touchd.localization.estimator import Estimator
from touchd.localization.fit import Bins, Fit, no_fit
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.noise import NoiseModel
from touchd.localization.pursuit import Pursuit
from touchd.localization.spline import Position

AMBIGUOUS_MM = 7.0
"""A finger is not placed if a position farther away than this explains the frame nearly as well."""
FIRST_STEPS = 5
STARTS, MANY_STARTS = 3, 24
"""Places to begin, the likeliest first; many where several fingers with shapes would make up for one."""
_BETTER = 0.5
"""A start elsewhere at an edge wins if it leaves less than this share: of wrong valleys it leaves 0 to 0.2 (twin)."""


class Landing:
    """Places a finger that nobody tracks yet.

    Parameters
    ----------
    estimator : Estimator
        Its network says where to begin.
    solver : GaussNewton
    pursuit : Pursuit
        Names other places to begin.
    noise : NoiseModel
    description : AtlasDescription
        Of the atlas: where it ends, and the wavelength.
    """

    def __init__(
        self, estimator: Estimator, solver: GaussNewton, pursuit: Pursuit, noise: NoiseModel,
        description: AtlasDescription,
    ) -> None:  # fmt: skip
        self._estimator, self._solver, self._pursuit, self._noise = estimator, solver, pursuit, noise
        self._low_mm, self._high_mm = description.low_mm, description.high_mm
        wavenumbers = sorted(description.wavenumber_rad_m)
        self._half_wave_mm = math.pi / wavenumbers[len(wavenumbers) // 2] * 1e3 if wavenumbers else 0.0

    def fit(self, detection: Detection, bins: Bins, signal: float, *, anywhere: bool = False) -> Fit:
        """Fit one finger from where the network sees it; a faint one, which it may misplace, from others too.

        So is one near an edge, where the field repeats itself after half a wavelength along it, and one that may be
        `anywhere`, as the bins do not hold all of the frame.
        """
        estimate = self._estimator.estimate(detection)
        fits = []
        if math.isfinite(estimate.x_mm) and math.isfinite(estimate.y_mm):
            fits.append(self._solver.fit_one(bins, estimate.x_mm, estimate.y_mm, FIRST_STEPS))
        if not fits or anywhere or signal < CRITERIA.faint * self._noise.noise_energy:
            fits += self._fit_candidates(bins)
        return self._best_along_edge(bins, min(fits, key=attrgetter("residual_energy"), default=no_fit(bins.energy)))

    def elsewhere(self, detection: Detection, bins: Bins, signal: float, before_mm: Sequence[Position]) -> Fit | None:
        """Return the fit of the one finger that was followed where it has gone, if too quickly for that; else None.

        Another one beside it would leave more: then this finds nothing.
        """
        noise_energy = self._noise.noise_energy
        if len(before_mm) != 1 or signal < CRITERIA.faint * noise_energy:
            return None
        fit = self._solver.with_shapes(bins, self.fit(detection, bins, signal), noise_energy)
        explains = self._noise.excess(fit.residual_energy, signal) < CRITERIA.fair
        return fit if explains and math.dist(fit.positions_mm[0], before_mm[0]) > CRITERIA.merged_mm else None

    def or_one(self, bins: Bins, fit: Fit) -> Fit:
        """Return several fingers with shapes, or one that leaves less than they do where no start has led.

        Shapes of several make up for one finger elsewhere, mostly on a disc or near an edge.
        """
        noise_energy = self._noise.noise_energy
        signal = bins.energy - noise_energy
        if len(fit.shapes) < 2 or fit.residual_energy - noise_energy < CRITERIA.search_above * signal:
            return fit
        ones = self._fit_candidates(bins, MANY_STARTS) + self._fit_along_edge(bins, *fit.positions_mm[0])
        best = min(ones, key=attrgetter("residual_energy"))
        if best.residual_energy - noise_energy < CRITERIA.fair * signal:
            best = self._solver.with_shapes(bins, best, noise_energy)
        return best if best.residual_energy < fit.residual_energy else fit

    def _best_along_edge(self, bins: Bins, fit: Fit) -> Fit:
        """Return a fit, or if it lies near an edge one from elsewhere that leaves much less."""
        left = fit.residual_energy - self._noise.noise_energy
        if not fit.positions_mm or left < CRITERIA.enough * bins.energy:
            return fit
        others = self._fit_along_edge(bins, *fit.positions_mm[0])
        if not others:
            return fit
        best = min([*others, *self._fit_candidates(bins)], key=attrgetter("residual_energy"))
        return best if best.residual_energy - self._noise.noise_energy < _BETTER * left else fit

    def _fit_along_edge(self, bins: Bins, x_mm: float, y_mm: float) -> list[Fit]:
        """Fit one finger from half a wavelength to either side of a position near an edge; none elsewhere."""
        half = self._half_wave_mm
        by_side = min(x_mm - self._low_mm[0], self._high_mm[0] - x_mm) < half
        by_end = min(y_mm - self._low_mm[1], self._high_mm[1] - y_mm) < half
        starts_mm = [(x_mm + step, y_mm) for step in (-half, half)] if by_end else []
        starts_mm += [(x_mm, y_mm + step) for step in (-half, half)] if by_side else []
        return [self._solver.fit_one(bins, *start_mm, FIRST_STEPS) for start_mm in starts_mm]

    def _fit_candidates(self, bins: Bins, count: int = STARTS) -> list[Fit]:
        return [
            self._solver.fit_one(bins, *candidate_mm, FIRST_STEPS)
            for candidate_mm in self._pursuit.candidates(bins.vector, count)
        ]

    def is_implausible(self, bins: Bins, fit: Fit, signal: float, excess: float) -> bool:
        """Return whether what has landed is no finger: fits that leave the share `excess` may be of something else.

        Shapes that no finger has make up for wrong positions where the field is badly known, and several for a palm.
        """
        if len(fit.shapes) > 1:
            most = (
                CRITERIA.good if fit.scattered is None else CRITERIA.fair
            )  # resonances leave more, and shapes take it
            long = excess > most and elongation(fit) > CRITERIA.most_elongation
            if long or oval_mm2(fit) > CRITERIA.most_oval_mm2:
                return True
        return len(fit.positions_mm) == 1 and self._is_ambiguous(bins, fit, signal)

    def _is_ambiguous(self, bins: Bins, fit: Fit, signal: float) -> bool:
        """Return whether a finger elsewhere explains a frame nearly as well as the one fitted.

        Fingers at the edge, where the field is badly known, and faint ones may be placed in a wrong valley, and
        coloured noise resembles a finger.
        """
        noise = self._noise
        faint = signal < CRITERIA.faint * noise.noise_energy
        left = fit.residual_energy - noise.noise_energy
        if left > CRITERIA.good * signal:
            # Shapes may make up for a wrong position: points are compared with points.
            left = max(left, fit.points_energy - noise.noise_energy)
        poor = left > CRITERIA.poor * signal
        if not poor and not faint:
            return False
        if poor:
            ceiling = noise.noise_energy + CRITERIA.rival * left
        elif noise.is_alike:
            ceiling = noise.ceiling
        else:
            ceiling = fit.residual_energy + CRITERIA.rival_noise * noise.variance
        rivals = [
            other for other in self._fit_candidates(bins) + self._fit_along_edge(bins, *fit.positions_mm[0])
            if other.residual_energy < ceiling and math.dist(other.positions_mm[0], fit.positions_mm[0]) > AMBIGUOUS_MM
        ]  # fmt: skip
        if not poor or not fit.shapes:
            return bool(rivals)
        # Points leave so much of a wide face anywhere: whether a shape elsewhere explains it is what counts.
        ceiling = noise.noise_energy + CRITERIA.rival * max(fit.residual_energy - noise.noise_energy, 0.0)
        return any(
            shaped.residual_energy < ceiling and math.dist(shaped.positions_mm[0], fit.positions_mm[0]) > AMBIGUOUS_MM
            for shaped in (self._solver.with_shapes(bins, other, noise.noise_energy) for other in rivals)
        )
