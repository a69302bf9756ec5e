"""Kernel ridge regression of each bin's field from noisy touches, and its prior, the field's covariance.

The field of a bin is the product of two waves of the plate. Far from the edges each wave is a random sum of plane waves
from all directions, with covariance J0(k r) over a distance r (Berry, J. Phys. A 10:2083, 1977). Their product has the
covariance J0(k r)^2, without spatial frequencies above 2 k. A small white share within that band, 2 J1(K r) / (K r),
covers near fields of edges and discs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, cho_factor, cho_solve, lapack, solve_triangular
from scipy.spatial.distance import cdist
from scipy.special import j0, j1
from threadpoolctl import ThreadpoolController

from touchd.evaluation.dataset import BASELINE_NOISE, Dataset, complex_bins

Array = NDArray[np.float32]
Complex = NDArray[np.complex64]
Floats = NDArray[np.float64]
T = TypeVar("T")

BAND_MARGIN = 1.15
"""Factor by which the white share's band exceeds that of the waves."""
WHITE_SHARE = 0.05
SPREAD = 0.02
"""Relative spread of the wavenumber: the dispersion is inexact, and a bin has a bandwidth."""
_NODES = 200  # per unit of 2 k r: linear interpolation to 1e-6, else the matrix is not positive definite
_ROWS = 64  # a block of this many rows fits the cache
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


def covariance(
    distance_mm: Floats,
    wavenumber_per_mm: float,
    white_share: float = WHITE_SHARE,
    *,
    waves: int = 2,
    margin: float = BAND_MARGIN,
) -> Floats:
    """Return the covariance of a product of `waves` waves at distances (mm) of any shape, 1 at 0."""
    r = np.asarray(distance_mm, dtype=np.float64)
    near = wavenumber_per_mm * np.linspace(1 - SPREAD, 1 + SPREAD, 5)
    free = sum(j0(k * r) ** waves for k in near) / len(near)
    at = np.maximum(waves * margin * wavenumber_per_mm * r, 1e-9)
    return np.asarray((1 - white_share) * free + white_share * 2 * j1(at) / at)


class Kernel:
    """A tabulated kernel, for matrices of distances up to `reach_mm`, in float32."""

    def __init__(self, wavenumber_per_mm: float, reach_mm: float, white_share: float = WHITE_SHARE) -> None:
        self._per_mm = 2 * wavenumber_per_mm * _NODES
        nodes_mm = np.arange(np.ceil(reach_mm * self._per_mm) + 3) / self._per_mm
        table = covariance(nodes_mm, wavenumber_per_mm, white_share)
        self._value, self._step = _line(table)
        # Derivative with respect to r, over r: times a component of the distance it is a partial derivative.
        slope = np.gradient(table, nodes_mm) / np.maximum(nodes_mm, 1e-9)
        slope[0] = slope[1]
        self._slope, self._slope_step = _line(slope)

    def __call__(self, distance_mm: Array) -> Array:
        """Return the kernel at a matrix of distances (mm)."""
        return self._look_up(distance_mm, self._value, self._step)

    def slope(self, distance_mm: Array) -> Array:
        """Return the kernel's derivative with respect to distance, divided by distance (1/mm^2)."""
        return self._look_up(distance_mm, self._slope, self._slope_step)

    def _look_up(self, distance_mm: Array, value: Array, step: Array) -> Array:
        found = np.empty_like(distance_mm)
        for start in range(0, len(found), _ROWS):
            at = distance_mm[start : start + _ROWS] * np.float32(self._per_mm)
            below = at.astype(np.int32)
            at -= below
            found[start : start + _ROWS] = value[below] + at * step[below]
        return found


_kernel = lru_cache(maxsize=32)(Kernel)
"""The same few are used again and again, and of few touches the tables took half the time."""
_linear_algebra = cache(ThreadpoolController)
"""Finds the libraries that this module has loaded, which takes 2 ms: as long as a bin of few touches."""


def distances(one_mm: Floats, other_mm: Floats) -> Array:
    """Return the distances (n, m) between positions (n, 2) and (m, 2), mm."""
    return cdist(one_mm, other_mm).astype(np.float32)


def _line(table: Floats) -> tuple[Array, Array]:
    return table.astype(np.float32), np.diff(table, append=table[-1]).astype(np.float32)


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
        return _kernel(float(self.prior.wavenumber_per_mm[b]), self._reach_mm, self.prior.white_share)

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


def weigh(inverse: Array, targets: Array) -> Array:
    """Return the weights (n, 2 * channels) that an inverse, lower triangle, gives to targets."""
    return np.ascontiguousarray(blas.ssymm(1.0, inverse, targets, lower=1))


def smooth(inverse: Array, penalty: Array, targets: Array) -> Array:
    """Return the field (n, 2 * channels) at the touches' positions, for targets and an inverse's weights."""
    return np.asarray(targets - penalty[:, None] * weigh(inverse, targets))


def each(work: Callable[[int], T], bins: Iterable[int], advance: Callable[[], None] = lambda: None) -> list[T]:
    """Run `work` for each bin on all cores, and call `advance` after each."""
    results = []
    # One bin per core: nested threads of the linear algebra would only compete.
    with _linear_algebra().limit(limits=1), ThreadPoolExecutor(min(os.cpu_count() or 1, MOST_THREADS)) as pool:
        for result in pool.map(work, [int(b) for b in bins]):
            results.append(result)
            advance()
    return results
