"""Kernel ridge regression of each bin's field from noisy touches."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, cho_factor, cho_solve, lapack, solve_triangular
from threadpoolctl import threadpool_limits

from touchd.evaluation.dataset import BASELINE_NOISE, Dataset, complex_bins
from touchd.training.field.kernel import WHITE_SHARE, Kernel, distances

Array = NDArray[np.float32]
Complex = NDArray[np.complex64]
Floats = NDArray[np.float64]
T = TypeVar("T")

RIDGE = 1e-4
"""Share of a bin's signal added to its noise, for what no field of this band explains."""
LEAST_SIGNAL = 1e-3
"""Least signal of a bin, relative to its noise."""
LEAST_VARIANCE = 1e-6
"""Least expected error, as a share of the prior's variance: single precision tells no less."""
FAINT = 0.1
"""Least amplitude in a touch's weight, relative to the average."""
MOST_THREADS = 8
"""Limit of threads; each needs a few n x n matrices."""
BEYOND_MM = 40.0
"""Largest distance beyond the touches at which the field is evaluated."""


@dataclass(frozen=True, slots=True)
class Touches:
    """n labelled touches in the frequency domain."""

    position_mm: Floats
    """Shape (n, 2)."""
    values: Complex
    """Residuals, shape (n, channels, bins), ADC counts."""
    noise: float
    """Noise variance of each complex value."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Assumptions on each bin's field."""

    wavenumber_per_mm: Floats
    """Wavenumber of the plate's flexural wave, shape (bins,)."""
    ridge: float = RIDGE
    white_share: float = WHITE_SHARE


def touches_of(dataset: Dataset, indices: NDArray[np.int64]) -> Touches:
    """Return the touches of a dataset with these indices, in the frequency domain."""
    a = dataset.acquisition
    values = complex_bins(dataset.residual[indices], a.channels).astype(np.complex64)
    noise = BASELINE_NOISE * dataset.noise**2 * float(np.square(a.window(dataset.taper)).sum())
    return Touches(dataset.position_mm[indices].astype(np.float64), values, noise)


class Regression:
    """Fields of all bins from n touches of given amplitudes.

    In all methods `amplitude`, of shape (n,), holds the amplitudes in the bin.
    """

    def __init__(self, touches: Touches, prior: Prior) -> None:
        self.touches, self.prior = touches, prior
        signal = np.square(np.abs(touches.values)).mean(axis=(0, 1), dtype=np.float64) - touches.noise
        self.scale: Floats = np.sqrt(np.maximum(signal, max(LEAST_SIGNAL * touches.noise, 1e-12)))
        """Root mean square of each bin's signal, ADC counts, shape (bins,)."""
        self.ridge: Floats = touches.noise / self.scale**2 + prior.ridge
        self.distance_mm = distances(touches.position_mm, touches.position_mm)
        # The longest distance is the bounding box's diagonal, possibly without touches at its ends.
        self._reach_mm = float(np.linalg.norm(np.ptp(touches.position_mm, axis=0))) + BEYOND_MM

    def kernel(self, b: int) -> Kernel:
        """Return a bin's kernel."""
        return Kernel(float(self.prior.wavenumber_per_mm[b]), self._reach_mm, self.prior.white_share)

    def penalty(self, b: int, amplitude: Complex) -> Array:
        """Return the system's diagonal term: the noise of a touch of amplitude z counts as noise / |z|."""
        return np.asarray(self.ridge[b] / np.maximum(np.abs(amplitude), FAINT) ** 2, dtype=np.float32)

    def targets(self, b: int, amplitude: Complex) -> Array:
        """Return the touches at amplitude 1, in units of the bin's scale, shape (n, 2 * channels)."""
        unit = self.touches.values[:, :, b] / (np.float32(self.scale[b]) * amplitude[:, None])
        return np.ascontiguousarray(unit.astype(np.complex64)).view(np.float32)

    def inverse(self, b: int, amplitude: Complex) -> Array:
        """Return the inverse of a bin's system, shape (n, n), lower triangle only."""
        factor, _ = lapack.spotrf(self._system(b, amplitude).T, lower=1, overwrite_a=1)
        inverse, _ = lapack.spotri(factor, lower=1, overwrite_c=1)
        return np.asarray(inverse)

    def apply(self, inverse: Array, targets: Array) -> Array:
        """Return the weights (n, 2 * channels) of targets."""
        return np.ascontiguousarray(blas.ssymm(1.0, inverse, targets, lower=1))

    def weights(self, b: int, amplitude: Complex) -> Array:
        """Return each touch's weight, shape (n, 2 * channels)."""
        factor = cho_factor(self._system(b, amplitude).T, lower=True, overwrite_a=True, check_finite=False)
        solved = cho_solve(factor, self.targets(b, amplitude), check_finite=False)
        return np.ascontiguousarray(solved, dtype=np.float32)

    def at(self, b: int, weights: Array, positions_mm: Floats) -> Complex:
        """Evaluate the field (m, channels) at positions (m, 2), ADC counts."""
        kernel, rows = self.kernel(b), 512
        field = np.empty((len(positions_mm), weights.shape[1]), np.float32)
        for start in range(0, len(positions_mm), rows):
            apart_mm = distances(positions_mm[start : start + rows], self.touches.position_mm)
            field[start : start + rows] = kernel(apart_mm) @ weights
        found: Complex = field.view(np.complex64) * np.float32(self.scale[b])
        return found

    def variance(self, b: int, amplitude: Complex, positions_mm: Floats) -> Floats:
        """Return the expected square error of the field at positions (m, 2), as a share of the prior's variance.

        Of noise and assumptions as the ridge has them (Rasmussen and Williams, Gaussian Processes for Machine Learning,
        eq. 2.26).
        """
        factor, _ = lapack.spotrf(self._system(b, amplitude).T, lower=1, overwrite_a=1)
        near = self.kernel(b)(distances(self.touches.position_mm, positions_mm))
        explained = solve_triangular(factor, near, lower=True, overwrite_b=True, check_finite=False)
        return np.asarray(np.maximum(1 - np.square(explained).sum(axis=0, dtype=np.float64), LEAST_VARIANCE))

    def _system(self, b: int, amplitude: Complex) -> Array:
        system = self.kernel(b)(self.distance_mm)
        system[np.diag_indices(len(system))] += self.penalty(b, amplitude)
        return system


def smooth(inverse: Array, penalty: Array, targets: Array) -> Array:
    """Return the field (n, 2 * channels) at the touches' positions, for targets and an inverse's weights."""
    return np.asarray(targets - penalty[:, None] * blas.ssymm(1.0, inverse, targets, lower=1))


def each(work: Callable[[int], T], bins: Iterable[int], advance: Callable[[], None] = lambda: None) -> list[T]:
    """Run `work` for each bin on all cores, and call `advance` after each."""
    results = []
    # One bin per core: nested threads of the linear algebra would only compete.
    with threadpool_limits(1), ThreadPoolExecutor(min(os.cpu_count() or 1, MOST_THREADS)) as pool:
        for result in pool.map(work, [int(b) for b in bins]):
            results.append(result)
            advance()
    return results
