"""Predict each touch from all others: to choose the field's prior, and to correct label errors.

With the weights a = C t of all touches, C the inverse system, the error of predicting touch i from all others is
a_i / C_ii (Rasmussen and Williams, Gaussian Processes for Machine Learning, eq. 5.12). The weights of the others are
a - C_i a_i / C_ii, so their field near touch i follows too, without a regression of its own.

A robot or a hand places touches imprecisely. Located in the field of all others, independently of its own label, a
touch's corrected position lies between label and estimate, weighted by their variances. Label errors are modelled as
normal, with a common deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from touchd.training.field.place import Linearised, linearise
from touchd.training.field.regression import Array, Complex, Floats, Prior, Regression, Touches, each, weigh

LEAST_LABEL_NOISE_MM = 0.05
"""Label errors below this deviation are not corrected: the field's own error is of that size."""
MOST_MM = 1.5
"""A touch located farther from its label is in a wrong valley, or has a wrong label: it keeps the label, and counts as
this far off."""
CHI2_MEDIAN = 0.84
"""Median over mean of chi squared with four degrees of freedom: of two axes and four channels, unequally sure."""
REGION = 1200
"""Number of touches that choose the prior; the cost grows with its cube."""
INNER_SHARE = 0.88
"""Share of the region's sides; touches closer to its border lack neighbours and are ignored."""
RIDGES = (1e-4, 1e-3, 1e-2, 3e-2, 1e-1)
WHITE_SHARES = (0.01, 0.05, 0.15)
_ROWS = 256


def left_out(regression: Regression, b: int, amplitude: Complex) -> Complex:
    """Return the error of predicting each touch of a bin, of amplitudes (n,), from all others, shape (n, channels)."""
    inverse = regression.inverse(b, amplitude)
    weights = weigh(inverse, regression.targets(b, amplitude)).view(np.complex64)
    unit = weights / np.diag(inverse)[:, None]
    error: Complex = unit * amplitude[:, None] * np.float32(regression.scale[b])
    return error


@dataclass(frozen=True, slots=True)
class Displaced:
    """Displacements of touches from their assumed positions."""

    by_mm: Floats
    """Shape (n, 2)."""
    covariance: Floats
    """Covariance of `by_mm` due to noise and unexplained energy, shape (n, 2, 2), mm^2."""


def displacements(
    regression: Regression, amplitude: Complex, bins: NDArray[np.int64], inverses: list[Array]
) -> Displaced:
    """Locate each touch in the field of all others, by one Gauss-Newton step from its assumed position.

    `amplitude` has shape (n, all bins); `inverses` holds the inverse system, lower triangle, of each of the `bins`.
    """

    def one(i: int) -> Complex:
        b = int(bins[i])
        field = predicted_by_others(regression, b, amplitude[:, b], inverses[i])
        return np.asarray(field * amplitude[None, :, b, None] * np.float32(regression.scale[b]))

    field = np.stack(each(one, range(len(bins))), axis=-1)  # (3, n, channels, bins)
    channels = field.shape[2]
    values = regression.touches.values[:, :, bins].reshape(field.shape[1], -1).astype(np.complex128)
    u, by_x, by_y = field.reshape(3, len(values), -1).astype(np.complex128)
    near = linearise(values, u, by_x, by_y, channels)
    fisher_information = near.fisher_information.sum(axis=1) + 1e-30 * np.eye(2)
    gradient = near.gradient.sum(axis=1)
    by_mm = np.linalg.solve(fisher_information, gradient[:, :, None])[:, :, 0]
    unexplained = near.residual_energy - np.einsum("ni,ni->n", gradient, by_mm)
    variance = np.maximum(unexplained, 1e-30) / max(2 * values.shape[1] - 4, 1)
    covariance = np.linalg.inv(fisher_information) * variance[:, None, None]
    return Displaced(np.asarray(by_mm), covariance + _jitter_covariance(near, by_mm, covariance))


def _jitter_covariance(near: Linearised, by_mm: Floats, covariance: Floats) -> Floats:
    """Return the covariance of displacements due to errors that are independent in each channel, (n, 2, 2), mm^2.

    A label error displaces a touch alike in all channels. What displaces it in each channel apart (a receiver's jitter,
    a scan's) is alike in all bins of a channel, so that the noise of single bins does not tell it. Its variance per
    axis follows from the jackknife over channels (Efron and Stein, Annals of Statistics 9:586, 1981).
    """
    channels, eye = near.gradient.shape[1], np.eye(2)
    if channels < 3:
        return np.zeros_like(covariance)
    parts, whole = near.fisher_information, near.fisher_information.sum(axis=1, keepdims=True) + 1e-30 * eye
    others = whole - parts + 1e-30 * eye
    without_mm = np.linalg.solve(others, (near.gradient.sum(axis=1, keepdims=True) - near.gradient)[..., None])[..., 0]
    spread = np.square(without_mm - by_mm[:, None]).sum(axis=(1, 2)) * (channels - 1) / channels
    # How a displacement of channel j moves the estimate (share), and the one without channel c (apart).
    share = np.linalg.solve(whole, parts)
    apart = np.linalg.solve(others[:, :, None], parts[:, None]) * (1 - np.eye(channels))[:, :, None, None]
    expected = np.square(apart - share[:, None]).sum(axis=(1, 2, 3, 4)) * (channels - 1) / channels
    sure = np.linalg.norm(by_mm, axis=1) < MOST_MM
    excess = spread[sure] / expected[sure] - np.trace(covariance, axis1=1, axis2=2)[sure] / expected[sure]
    variance = max(float(np.median(excess)) / CHI2_MEDIAN, 0.0) if sure.any() else 0.0
    return np.asarray(variance * np.einsum("ncij,nckj->nik", share, share))


def predicted_by_others(regression: Regression, b: int, amplitude: Complex, inverse: Array) -> Complex:
    """Predict the field at each touch from all others, and its derivatives with respect to x and y (1/mm).

    At amplitude 1, in units of the bin's scale, shape (3, n, channels).
    """
    targets = regression.targets(b, amplitude)
    weights = weigh(inverse, targets)
    diagonal = np.diag(inverse)
    own = weights / diagonal[:, None]
    full = np.tril(inverse) + np.tril(inverse, -1).T
    kernel, position_mm = regression.kernel(b), regression.touches.position_mm.astype(np.float32)
    found = np.empty((3, *targets.shape), np.float32)
    found[0] = targets - own
    for start in range(0, len(targets), _ROWS):
        rows = slice(start, start + _ROWS)
        slope = kernel.slope(regression.distance_mm[rows])
        for axis in (0, 1):
            part = slope * (position_mm[rows, None, axis] - position_mm[None, :, axis])
            found[1 + axis, rows] = part @ weights - (part * full[rows]).sum(axis=1)[:, None] * own[rows]
    return found.view(np.complex64)


def label_noise_mm(displaced: Displaced) -> float:
    """Estimate the label error's deviation per axis by maximum likelihood, mm."""
    near = np.linalg.norm(displaced.by_mm, axis=1) < MOST_MM
    by_mm, covariance = displaced.by_mm[near], displaced.covariance[near]
    if len(by_mm) < 3:
        return 0.0

    def surprise(deviation_mm: float) -> float:
        total = covariance + deviation_mm**2 * np.eye(2)
        solved = np.linalg.solve(total, by_mm[:, :, None])[:, :, 0]
        return float((np.log(np.linalg.det(total)) + np.einsum("ni,ni->n", by_mm, solved)).mean())

    return float(minimize_scalar(surprise, bounds=(1e-4, MOST_MM), method="bounded").x)


def replaced(label_mm: Floats, position_mm: Floats, displaced: Displaced, noise_mm: float) -> Floats:
    """Return the most probable positions (n, 2), given labels (n, 2) with an error of deviation `noise_mm` per axis.

    `displaced` holds the displacements from `position_mm`.
    """
    off_mm = position_mm + displaced.by_mm - label_mm
    prior = noise_mm**2 * np.eye(2)
    moved = (prior @ np.linalg.solve(displaced.covariance + prior, off_mm[:, :, None]))[:, :, 0]
    far = np.linalg.norm(off_mm, axis=1) > max(MOST_MM, 4 * noise_mm)
    return np.where(far[:, None], label_mm, label_mm + moved)


@dataclass(frozen=True, slots=True)
class Region:
    """Touches of a part of the plate."""

    touches: Touches
    at: NDArray[np.int64]
    """Their indices among all touches, shape (n,)."""
    inner: NDArray[np.bool_]
    """Whether a touch has the same neighbours as on the whole plate, shape (n,)."""


def region_of(touches: Touches, count: int = REGION) -> Region:
    """Select `count` touches in a corner of the touched part.

    The field is hardest to predict near the plate's edges and discs, hence a corner.
    """
    low, high = touches.position_mm.min(axis=0), touches.position_mm.max(axis=0)
    off = ((touches.position_mm - low) / np.maximum(high - low, 1e-9)).max(axis=1)
    at = np.sort(np.argsort(off, kind="stable")[:count])
    whole = len(at) == len(off)
    inner = np.ones(len(at), bool) if whole else off[at] <= INNER_SHARE * off[at].max()
    return Region(Touches(touches.position_mm[at], touches.values[at], touches.noise), at, inner)


def log_errors(region: Region, prior: Prior, amplitude: Complex, bins: NDArray[np.int64]) -> list[float]:
    """Return the log mean square error of predicting each touch from all others, for each of `bins`."""
    regression = Regression(region.touches, prior)

    def one(b: int) -> float:
        error = left_out(regression, b, amplitude[:, b])[region.inner]
        return float(np.log(np.square(np.abs(error)).mean()))

    return each(one, bins)


def choose(touches: Touches, prior: Prior, amplitude: Complex, bins: NDArray[np.int64]) -> Prior:
    """Choose the ridge and white share that minimise leave-one-out position errors in `bins`, starting from `prior`.

    The cost uses positions, not values: an error common to many bins changes values little, but positions much.
    """
    region = region_of(touches)
    mine = amplitude[region.at]

    def cost(candidate: Prior) -> float:
        regression = Regression(region.touches, candidate)
        inverses = each(lambda b: regression.inverse(b, mine[:, b]), bins)
        off_mm = np.linalg.norm(displacements(regression, mine, bins, inverses).by_mm[region.inner], axis=1)
        return float(np.square(np.minimum(off_mm, MOST_MM)).mean())

    best = min((replace(prior, ridge=ridge) for ridge in RIDGES), key=cost)
    return min((replace(best, white_share=share) for share in WHITE_SHARES), key=cost)
