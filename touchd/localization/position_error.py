"""Standard error of a position: by noise, by the error of the field, by what a fit leaves, and by a shape left out.

===================  ==========================================================================================
error                variance per axis
===================  ==========================================================================================
noise                of the bins, over the Fisher information
field                that of half the touches, `TYPICAL` of the atlas' mean, over the same
unusual touch        `UNUSUAL` times what the fit leaves beyond that, over the same
shape left out       of a point: its bias at this place for `MOMENT_MM2`, squared
===================  ==========================================================================================

A soft tip that is fitted as a point leaves little of the signal, but its second-order field moves the position: of
silicone tips by 0.03 mm of the 0.05 that they err by (twin).
"""

from __future__ import annotations

import math
from operator import mul

from touchd.localization.atlas import Atlas
from touchd.localization.fit import Fit, sigmas_mm
from touchd.localization.noise import NoiseModel
from touchd.localization.shape_information import shape_information

TYPICAL, TYPICAL_SHAPE, TYPICAL_SEVERAL = 0.4, 0.3, 0.5
"""Model error of half the touches, as a share of its mean, which is that of a few badly known places: of one point, of
one contact with a shape, whose five amplitudes take part of the error with them, and of several contacts, of which one
is at such a place more often (twin)."""
UNUSUAL = 14.0
"""Weight, relative to noise, of what a touch leaves beyond that: model error is alike in many bins. With it 68 and 95 %
of silicone and human fingers are within one and two standard errors at 40 to 80 dB (twin)."""
HIDDEN = 0.7
"""What half the fingertips leave, in the same unit: a shape's fit in noise that may hide as much leaves no less."""
MOMENT_MM2 = 0.2
"""Moment that a point may have unseen: 0 of a rigid tip, 0.2 to 0.5 of a soft one of silicone (twin)."""


class PositionError:
    """Tells the standard errors of a fit's positions.

    Parameters
    ----------
    atlas : Atlas
    noise : NoiseModel
    """

    def __init__(self, atlas: Atlas, noise: NoiseModel) -> None:
        self._noise = noise
        self._field_scale: float = atlas.description.field_scale
        self._bias2 = shape_information(atlas).bias2

    def variance(self, fit: Fit, sizes: list[float]) -> float:
        """Return noise and model error of a value, counts squared; `sizes` are the moduli of the fit's amplitudes."""
        noise = self._noise
        missed: float = noise.mean_error * sum(map(mul, sizes, sizes)) / 2
        left = max(fit.residual_energy - noise.ceiling, 0.0) / noise.active_bins
        typical = TYPICAL if len(sizes) == 1 else TYPICAL_SEVERAL
        if len(fit.shapes) == 1:
            typical = TYPICAL_SHAPE
            left = max(left, min((noise.ceiling - noise.noise_energy) / noise.active_bins, HIDDEN * missed))
        unusual = UNUSUAL * max(left - typical * missed, 0.0)
        return noise.variance + TYPICAL * self._field_scale * missed + unusual

    def sigmas_mm(self, fit: Fit, variance: float) -> list[float]:
        """Return the standard error of each position per axis; `variance` is that of the fit."""
        sigmas = sigmas_mm(fit.fisher_information, variance)
        for k, share in enumerate(fit.shares):
            sigmas[k] *= share**-0.5
        if not fit.shapes:
            for k, (x_mm, y_mm) in enumerate(fit.positions_mm):
                sigmas[k] = math.sqrt(sigmas[k] ** 2 + MOMENT_MM2**2 * self._bias2.at(x_mm, y_mm))
        return sigmas
