"""By how much a contact lags a mass: the phase of its amplitude, fitted as a mass whose lead grows along the band."""

from __future__ import annotations

import cmath

import numpy as np

from touchd.localization.atlas import Atlas, AtlasDescription
from touchd.localization.fit import Bins, Fit
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.noise import NoiseModel
from touchd.localization.spline import Spline

MASS_LEAD_S = 1.47e-6
"""By which a mass leads a silicone tip of 20 mm^2, the middle of the training's (piston on a half-space)."""
SILENT_SHARE = 0.9
"""Mean frequency of the bins over the middle of a band that chirps play to a silent plate: 0.88 to 0.91 (twin)."""


def mean_hz(description: AtlasDescription) -> float:
    """Return the mean frequency of the bins that tell a contact's phase.

    In steady state they are those that tell most, which may all lie in the upper third of the band.
    """
    d, a = description, description.acquisition
    if a.chirp.period_s is None:
        return SILENT_SHARE * sum(a.chirp.band_hz) / 2
    return sum(d.bins) / len(d.bins) * a.sample_rate_hz / a.samples


class MassPhase:
    """Compares the contacts of a fit with masses at the same positions.

    What lies along the plate's own movement tells nothing: a plate that has warmed under a finger turns the phase of a
    drop that lies there too.

    Parameters
    ----------
    atlas : Atlas
    solver : GaussNewton
        Of the fits.
    noise : NoiseModel
        Knows the directions of that movement.
    """

    def __init__(self, atlas: Atlas, solver: GaussNewton, noise: NoiseModel) -> None:
        d = atlas.description
        a = d.acquisition
        self._solver, self._noise = solver, noise
        self._parts = a.channels, 2, len(d.bins)
        self._rows = np.zeros((3, atlas.size), atlas.coefficients.dtype)
        self._spline = Spline(atlas, self._rows)
        self._turn = np.exp(2j * np.pi * MASS_LEAD_S * np.array(d.bins) * a.sample_rate_hz / a.samples)

    def lag_rad(self, bins: Bins, fit: Fit, k: int) -> tuple[float, float]:
        """Return by how much contact `k` of a fit lags a mass, and the share of its energy that tells it.

        Both are 0 of a contact without energy.
        """
        left = self._solver.residual(bins, fit, without=k)  # without the bins that are left out
        self._spline.at(*fit.positions_mm[k])
        real, imaginary = self._rows[0].reshape(2, *self._parts[::2])
        mass = (real + 1j * imaginary) * self._turn
        rows = np.empty((2, *self._parts))
        rows[0, :, 0], rows[0, :, 1] = mass.real, mass.imag
        rows[1, :, 0], rows[1, :, 1] = -mass.imag, mass.real
        table = rows.reshape(2, -1) if bins.mask is None else rows.reshape(2, -1) * bins.mask
        own = self._noise.without_plate(table)
        (a, b), (_, c) = (own @ own.T).tolist()
        x, y = (own @ left).tolist()
        det, energy = a * c - b * b, float(table[0] @ table[0])
        amplitude = complex(c * x - b * y, a * y - b * x)
        if not det > 0 or not amplitude:
            return 0.0, 0.0
        # Variance of the phase: that of the part at right angles to the amplitude.
        s, t = -amplitude.imag / abs(amplitude), amplitude.real / abs(amplitude)
        across = (c * s * s - 2 * b * s * t + a * t * t) / det
        return -cmath.phase(amplitude), 1 / (energy * across)
