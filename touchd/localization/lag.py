"""By how much a contact lags a mass: the phase of its amplitude, fitted as a mass whose lead grows along the band."""

from __future__ import annotations

import cmath

import numpy as np

from touchd.localization.atlas import Atlas
from touchd.localization.fit import Bins, Fit
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.spline import Spline

MASS_LEAD_S = 1.47e-6
"""By which a mass leads a silicone tip of 20 mm^2, the middle of the training's (piston on a half-space)."""


class MassPhase:
    """Compares the contacts of a fit with masses at the same positions.

    Parameters
    ----------
    atlas : Atlas
    solver : GaussNewton
        Of the fits.
    """

    def __init__(self, atlas: Atlas, solver: GaussNewton) -> None:
        d = atlas.description
        a = d.acquisition
        self._solver = solver
        self._parts = a.channels, 2, len(d.bins)
        self._rows = np.zeros((3, atlas.size), atlas.coefficients.dtype)
        self._spline = Spline(atlas, self._rows)
        self._turn = np.exp(2j * np.pi * MASS_LEAD_S * np.array(d.bins) * a.sample_rate_hz / a.samples)

    def lag_rad(self, bins: Bins, fit: Fit, k: int) -> float:
        """Return by how much contact `k` of a fit lags a mass; 0 of a contact without energy."""
        left = self._solver.residual(bins, fit, without=k).reshape(self._parts)  # without the bins that are left out
        self._spline.at(*fit.positions_mm[k])
        real, imaginary = self._rows[0].reshape(2, *self._parts[::2])
        mass = (real + 1j * imaginary) * self._turn
        return -cmath.phase(complex(np.vdot(mass, left[:, 0] + 1j * left[:, 1])))
