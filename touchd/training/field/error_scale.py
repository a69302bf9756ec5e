"""Estimate an atlas' field error and calibrate its standard errors, on touches outside its training part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from touchd.evaluation.dataset import BASELINE_NOISE
from touchd.localization.atlas import Atlas
from touchd.training.field.place import Floats, Placed, place

Spectra = NDArray[np.complexfloating]

WITHIN = 0.6827
"""Share of a Gaussian's errors within one standard error."""
LEVELS_DB = (50.0, 40.0)
"""Signal-to-noise ratios of the plate at which sigma is calibrated, beside the recording's own, dB."""
FAR_MM = 2.0
"""A larger error means a wrong valley, which a standard error does not describe."""
MOST = 30.0
"""Limit of either scale; a larger one points to another fault."""
SIMPLEX_SIZES = (1.0, 0.3, 0.1)
"""Of the searches for the two scales, in their logarithms."""
_NOISE_SEED = 0xA71A5


@dataclass(frozen=True, slots=True)
class Level:
    """Located touches at one noise level."""

    noise: float
    """Noise variance of a real feature, counts squared."""
    error_mm: Floats
    """Shape (n, 2)."""
    spread: Floats
    """Variance of the position along x and y for noise of variance 1, shape (n, 2)."""
    power: Floats
    """|z|^2, shape (n,)."""
    label_noise_mm: float = 0.0
    """Deviation of the label error per axis."""

    def sigma_mm(self, noise_scale: float, field_scale: float, error: float) -> Floats:
        """Return the standard error of each touch along x and y, shape (n, 2); `error` is the atlas' mean error."""
        variance = noise_scale * self.noise + field_scale * error * self.power / 2
        return np.asarray(np.sqrt(variance[:, None] * self.spread))

    def ratio(self, noise_scale: float, field_scale: float, error: float) -> Floats:
        """Return the absolute errors relative to their deviation, label error included, shape (n, 2)."""
        sigma_mm = self.sigma_mm(noise_scale, field_scale, error)
        return np.asarray(np.abs(self.error_mm) / np.hypot(sigma_mm, self.label_noise_mm))


def level_of(
    placed: Placed, true_mm: Floats, noise: float, label_noise_mm: float = 0.0, far_mm: float = FAR_MM
) -> Level:
    """Keep the touches located nearer than `far_mm`; `noise` is the variance of a real feature."""
    error_mm = placed.position_mm - true_mm
    near = np.linalg.norm(error_mm, axis=1) < far_mm
    spread = np.diagonal(np.linalg.inv(placed.fisher_information[near]), axis1=1, axis2=2)
    return Level(noise, error_mm[near], spread, np.square(np.abs(placed.amplitude[near])), label_noise_mm)


def noisy_levels(
    atlas: Atlas,
    values: Spectra,
    true_mm: Floats,
    noise_counts: float,
    *,
    held_counts: float = 0.0,
    label_noise_mm: float = 0.0,
    seed: int = _NOISE_SEED,
) -> list[tuple[float, Level]]:
    """Locate touches in the plate's own noise, and in more; return each level with its signal-to-noise ratio in dB.

    `noise_counts` is the standard deviation of a sample's noise, `held_counts` that of what `values` hold already.
    """
    d = atlas.description
    a, bins, plain = d.acquisition, d.bins, d.to_bins
    window = float(np.square(a.window(d.taper)).sum()) * float(np.square(d.bin_weights).mean())
    untouched = atlas.baseline - atlas.baseline.mean(axis=1, keepdims=True)
    plate = float(np.sqrt(np.square(untouched, dtype=np.float64).mean()))
    own_db = 20 * np.log10(plate / max(noise_counts, 1e-6))
    rng = np.random.default_rng(seed)
    levels = []
    for db in (own_db, *(level for level in LEVELS_DB if level < own_db - 1)):
        # Draw white noise in samples, so that the window correlates neighbouring bins.
        deviation = plate * 10 ** (-db / 20)
        added = np.sqrt(BASELINE_NOISE * max(deviation**2 - held_counts**2, 0.0))
        noise = rng.normal(size=(len(values), a.channels, a.samples)) @ plain * added
        placed = place(atlas, values + noise[:, :, : len(bins)] + 1j * noise[:, :, len(bins) :], true_mm)
        variance = BASELINE_NOISE * deviation**2 * window / 2
        levels.append((float(db), level_of(placed, true_mm, variance, label_noise_mm)))
    return levels


def field_error(values: Spectra, predicted: Spectra, amplitude: Spectra, noise: float) -> Floats:
    """Return the mean square error of the field at amplitude 1 by channel and bin, less the noise.

    `values` and `predicted`, of shape (n, channels, bins), are touches of amplitudes (n,), and the field at amplitude 1
    at their positions; `noise` is the variance of a complex value.
    """
    left = np.square(np.abs(values - amplitude[:, None, None] * predicted)).sum(axis=0, dtype=np.float64)
    power = float(np.square(np.abs(amplitude)).sum())
    return np.asarray(np.maximum(left - noise * len(values), 0.0) / max(power, 1e-30))


def calibrate(levels: list[Level], error: float) -> tuple[float, float]:
    """Return the scales of noise and field error; `error` is the atlas' mean field error."""
    return fit_scales(lambda one, other: [level.ratio(one, other, error) for level in levels])


def fit_scales(ratios: Callable[[float, float], Sequence[Floats]]) -> tuple[float, float]:
    """Return the two scales with which 68 % of the errors are within their standard error at each noise level.

    `ratios` maps two scales to the absolute errors at each level, relative to the standard error. Quantiles ignore the
    few touches in a wrong valley. Those of few touches make steps, on which a descent ends: it searches around the best
    again, and keeps the best.
    """
    most = np.log(MOST)

    def cost(logs: Floats) -> float:
        one, other = np.exp(np.clip(logs, -most, most))
        return float(np.square(np.log([np.quantile(each, WITHIN) for each in ratios(one, other)])).sum())

    best = minimize(cost, np.zeros(2), method="Nelder-Mead")
    for size in SIMPLEX_SIZES:
        simplex = best.x + size * np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
        found = minimize(cost, best.x, method="Nelder-Mead", options={"initial_simplex": simplex})
        best = min(best, found, key=lambda result: result.fun)
    one, other = np.exp(np.clip(best.x, -most, most)).tolist()
    return one, other
