"""Estimate an atlas' field error and calibrate its standard errors, on touches outside its training part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from touchd.localization.atlas import Atlas
from touchd.training.field.place import Placed
from touchd.training.field.regression import Floats

Spectra = NDArray[np.complexfloating]

WITHIN = 0.6827
"""Share of a Gaussian's errors within one standard error."""
LEVELS_DB = (50.0, 40.0)
"""Signal-to-noise ratios of the plate at which sigma is calibrated, beside the recording's own, dB."""
FAR_MM = 2.0
"""A larger error means a wrong valley, which a standard error does not describe."""
MOST = 30.0
"""Limit of either scale; a larger one points to another fault."""


@dataclass(frozen=True, slots=True)
class Level:
    """Located touches at one noise level."""

    noise: float
    """Noise variance of a real feature, counts squared."""
    error_mm: Floats
    """Shape (n, 2)."""
    fisher_information: Floats
    """Shape (n, 2, 2)."""
    power: Floats
    """|z|^2, shape (n,)."""
    label_noise_mm: float = 0.0
    """Deviation of the label error per axis."""

    def sigma_mm(self, noise_scale: float, field_scale: float, error: float) -> Floats:
        """Return the standard error of each touch along x and y, shape (n, 2); `error` is the atlas' mean error."""
        variance = noise_scale * self.noise + field_scale * error * self.power / 2
        inverse = np.linalg.inv(self.fisher_information)
        return np.asarray(np.sqrt(variance[:, None] * np.diagonal(inverse, axis1=1, axis2=2)))

    def ratio(self, noise_scale: float, field_scale: float, error: float) -> Floats:
        """Return errors relative to their deviation, label error included, shape (n, 2)."""
        sigma_mm = self.sigma_mm(noise_scale, field_scale, error)
        return np.asarray(self.error_mm / np.hypot(sigma_mm, self.label_noise_mm))


def field_error(values: Spectra, predicted: Spectra, amplitude: Spectra, noise: float) -> Floats:
    """Return the mean square error of the field at amplitude 1 by channel and bin, less the noise.

    Parameters
    ----------
    values, predicted : array, shape (n, channels, bins)
        Touches, and the field at their positions at amplitude 1.
    amplitude : array, shape (n,)
    noise : float
        Noise variance of a complex value.
    """
    left = np.square(np.abs(values - amplitude[:, None, None] * predicted)).sum(axis=0, dtype=np.float64)
    power = float(np.square(np.abs(amplitude)).sum())
    return np.asarray(np.maximum(left - noise * len(values), 0.0) / max(power, 1e-30))


def calibrate(levels: list[Level], error: float) -> tuple[float, float]:
    """Return scales of noise and field error with which 68 % of the errors per axis lie within sigma at each level.

    Quantiles ignore the few touches in a wrong valley.
    """

    def cost(logs: NDArray[np.float64]) -> float:
        noise_scale, field_scale = np.exp(np.clip(logs, -np.log(MOST), np.log(MOST)))
        ratios = [np.quantile(np.abs(level.ratio(noise_scale, field_scale, error)), WITHIN) for level in levels]
        return float(np.square(np.log(ratios)).sum())

    found = minimize(cost, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-7})
    noise_scale, field_scale = np.exp(np.clip(found.x, -np.log(MOST), np.log(MOST)))
    return float(noise_scale), float(field_scale)


def within_sigma(level: Level, atlas: Atlas) -> float:
    """Return the share of errors per axis within the atlas' predicted standard error."""
    d = atlas.description
    return float((np.abs(level.ratio(d.noise_scale, d.field_scale, float(atlas.error.mean()))) <= 1).mean())


def level_of(placed: Placed, true_mm: Floats, noise: float, label_noise_mm: float = 0.0) -> Level:
    """Keep the touches located in the right valley; `noise` is the variance of a real feature."""
    error_mm = placed.position_mm - true_mm
    near = np.linalg.norm(error_mm, axis=1) < FAR_MM
    return Level(
        noise,
        error_mm[near],
        placed.fisher_information[near],
        np.square(np.abs(placed.amplitude[near])),
        label_noise_mm,
    )
