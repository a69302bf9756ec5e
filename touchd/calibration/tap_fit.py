"""Fit taps to an atlas as the daemon does: contacts with a size and a shape."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from touchd.calibration.reduced_plate import Complex, Floats
from touchd.localization.atlas import Atlas
from touchd.localization.fit import Bins
from touchd.localization.gauss_newton import GaussNewton

_STEPS = 6
_NOISE = 1e-3
"""Share of a tap's energy that is taken for noise: shapes explain more than this, or taps stay points."""


class FittedTaps(NamedTuple):
    """n taps where a field explains them best."""

    position_mm: Floats
    """Shape (n, 2)."""
    left: Complex
    """What the field leaves of their values, shape (n, channels, bins)."""
    misfit: Floats
    """Share of their energy that is left, shape (n,)."""
    size: Floats
    """Moduli of their amplitudes, shape (n,)."""


def fit_taps(atlas: Atlas, values: Complex, start_mm: Floats) -> FittedTaps:
    """Fit taps of shape (n, channels, bins), ADC counts, from nearby positions (n, 2)."""
    solver = GaussNewton(atlas)
    vectors = np.stack([values.real, values.imag], axis=2).reshape(len(values), -1).astype(atlas.coefficients.dtype)
    position_mm, left = np.empty((len(values), 2)), np.empty_like(vectors)
    misfit, size = np.empty((2, len(values)))
    for k, vector in enumerate(vectors):
        bins, (x_mm, y_mm) = Bins(vector, None, float(vector @ vector)), start_mm[k].tolist()
        fit = solver.with_shapes(bins, solver.fit_one(bins, x_mm, y_mm, _STEPS), _NOISE * bins.energy)
        position_mm[k], left[k], size[k] = fit.positions_mm[0], solver.residual(bins, fit), abs(fit.amplitudes[0])
        # Of a tap without a signal nothing is explained.
        misfit[k] = fit.residual_energy / bins.energy if bins.energy > 0 else 1.0
    parts = left.reshape(len(values), values.shape[1], 2, -1).astype(np.float64)
    return FittedTaps(position_mm, parts[:, :, 0] + 1j * parts[:, :, 1], misfit, size)
