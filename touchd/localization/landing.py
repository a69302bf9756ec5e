"""Touch-down: where the one finger is that has just landed, and whether a frame tells that at all."""

from __future__ import annotations

import math

from touchd.detection.detection import Detection
from touchd.localization.contact_model import elongation, oval_mm2
from touchd.localization.estimator import Estimator
from touchd.localization.fit import Bins, Fit, no_fit
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.noise import NoiseModel
from touchd.localization.pursuit import Pursuit

AMBIGUOUS_MM = 7.0
"""A finger is not placed if a position farther away than this explains the frame nearly as well."""
FIRST_STEPS = 5


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
    """

    def __init__(self, estimator: Estimator, solver: GaussNewton, pursuit: Pursuit, noise: NoiseModel) -> None:
        self._estimator, self._solver, self._pursuit, self._noise = estimator, solver, pursuit, noise

    def fit(self, detection: Detection, bins: Bins, signal: float) -> Fit:
        """Fit one finger from where the network sees it; a faint one, which it may misplace, from others too."""
        estimate = self._estimator.estimate(detection)
        fits = []
        if math.isfinite(estimate.x_mm) and math.isfinite(estimate.y_mm):
            fits.append(self._solver.fit_one(bins, estimate.x_mm, estimate.y_mm, FIRST_STEPS))
            if signal >= CRITERIA.faint * self._noise.noise_energy:
                return fits[0]
        fits += self._fit_candidates(bins)
        return min(fits, key=lambda fit: fit.residual_energy, default=no_fit(bins.energy))

    def _fit_candidates(self, bins: Bins) -> list[Fit]:
        return [
            self._solver.fit_one(bins, *candidate.position_mm, FIRST_STEPS)
            for candidate in self._pursuit.candidates(bins.vector)
        ]

    def is_implausible(self, bins: Bins, fit: Fit, signal: float, excess: float) -> bool:
        """Return whether what has landed is no finger: fits that leave the share `excess` may be of something else.

        Shapes that no finger has make up for wrong positions where the field is badly known, and several for a palm.
        """
        if len(fit.shapes) > 1:
            long = excess > CRITERIA.good and elongation(fit) > CRITERIA.most_elongation
            if long or oval_mm2(fit) > CRITERIA.most_oval_mm2:
                return True
        return len(fit.positions_mm) == 1 and self._is_ambiguous(bins, fit, signal)

    def _is_ambiguous(self, bins: Bins, fit: Fit, signal: float) -> bool:
        """Return whether a finger elsewhere explains a frame nearly as well as the one fitted.

        Faint fingers and those at the edge, where the field is badly known, may be placed in a wrong valley, and
        coloured noise resembles a finger.
        """
        noise = self._noise
        faint = signal < CRITERIA.faint * noise.noise_energy
        left = fit.residual_energy - noise.noise_energy
        if left > CRITERIA.good * signal:
            # Shapes may make up for a wrong position: points are compared with points.
            left = max(left, fit.points_energy - noise.noise_energy)
        poor = left > CRITERIA.poor * signal
        if not poor and not (faint and noise.is_alike):
            return False
        ceiling = noise.noise_energy + CRITERIA.rival * left if poor else noise.ceiling
        return any(
            other.residual_energy < ceiling and math.dist(other.positions_mm[0], fit.positions_mm[0]) > AMBIGUOUS_MM
            for other in self._fit_candidates(bins)
        )
