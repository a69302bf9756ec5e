"""Kernel ridge regression of one bin's field from touches, each of which tells it with its own noise."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, cho_factor, cho_solve, lapack
from threadpoolctl import threadpool_limits

from touchd.evaluation.dataset import BASELINE_NOISE, Dataset
from touchd.training.field.kernel import WHITE_SHARE, Kernel, distances

Array = NDArray[np.float32]
Complex = NDArray[np.complex64]
Floats = NDArray[np.float64]
T = TypeVar("T")

RIDGE = 1e-4
"""Share of a bin's signal that is added to its noise, for what no field of this band explains."""
LEAST_SIGNAL = 1e-3
"""Of the noise: what a bin's signal is taken for where it drowns."""
FAINT = 0.1
"""A touch weaker than this share of the average is weighed as if it were as strong."""
MOST_THREADS = 8
"""Each holds a few matrices of n touches squared."""
BEYOND_MM = 40.0
"""How far beyond the touches the field may be asked for."""


@dataclass(frozen=True, slots=True)
class Touches:
    """n labelled touches in the frequency domain."""

    place_mm: Floats
    """Shape (n, 2)."""
    values: Complex
    """Residuals, shape (n, channels, bins), ADC counts."""
    noise: float
    """Variance of the noise in each complex value."""


@dataclass(frozen=True, slots=True)
class Prior:
    """What is assumed of each bin's field beforehand."""

    wavenumber_per_mm: Floats
    """Of the plate's flexural wave, shape (bins,)."""
    ridge: float = RIDGE
    white_share: float = WHITE_SHARE


def touches_of(dataset: Dataset, indices: NDArray[np.int64]) -> Touches:
    """Return some touches of a dataset in the frequency domain."""
    a = dataset.acquisition
    parts = dataset.residual[indices].reshape(len(indices), a.channels, 2, -1)
    values = (parts[:, :, 0] + 1j * parts[:, :, 1]).astype(np.complex64)
    noise = BASELINE_NOISE * dataset.noise**2 * float(np.square(np.hanning(a.samples)).sum())
    return Touches(dataset.position_mm[indices].astype(np.float64), values, noise)


class Regression:
    """The fields of all bins, as n touches at given strengths tell them.

    In all methods `strength` has the shape (n,): that of the touches in the bin.

    Parameters
    ----------
    touches : Touches
    prior : Prior
    """

    def __init__(self, touches: Touches, prior: Prior) -> None:
        self.touches, self.prior = touches, prior
        signal = np.square(np.abs(touches.values)).mean(axis=(0, 1), dtype=np.float64) - touches.noise
        self.scale: Floats = np.sqrt(np.maximum(signal, max(LEAST_SIGNAL * touches.noise, 1e-12)))
        """Root mean square of each bin's signal, ADC counts, shape (bins,)."""
        self.ridge: Floats = touches.noise / self.scale**2 + prior.ridge
        self.distance_mm = distances(touches.place_mm, touches.place_mm)
        # From corner to corner, where there may be no touches.
        self._reach_mm = float(np.linalg.norm(np.ptp(touches.place_mm, axis=0))) + BEYOND_MM

    def kernel(self, b: int) -> Kernel:
        """Return the kernel of a bin."""
        return Kernel(float(self.prior.wavenumber_per_mm[b]), self._reach_mm, self.prior.white_share)

    def penalty(self, b: int, strength: Complex) -> Array:
        """Return what is added to the system's diagonal: a touch of strength z tells with its noise over |z|."""
        return np.asarray(self.ridge[b] / np.maximum(np.abs(strength), FAINT) ** 2, dtype=np.float32)

    def targets(self, b: int, strength: Complex) -> Array:
        """Return the touches at strength 1, in units of the bin's scale, shape (n, 2 * channels)."""
        unit = self.touches.values[:, :, b] / (np.float32(self.scale[b]) * strength[:, None])
        return np.ascontiguousarray(unit.astype(np.complex64)).view(np.float32)

    def inverse(self, b: int, strength: Complex) -> Array:
        """Return the inverse of a bin's system, whose lower triangle alone is filled, shape (n, n)."""
        factor, _ = lapack.spotrf(self._system(b, strength).T, lower=1, overwrite_a=1)
        inverse, _ = lapack.spotri(factor, lower=1, overwrite_c=1)
        return np.asarray(inverse)

    def apply(self, inverse: Array, targets: Array) -> Array:
        """Return the weights (n, 2 * channels) that an inverse gives to targets."""
        return np.ascontiguousarray(blas.ssymm(1.0, inverse, targets, lower=1))

    def weights(self, b: int, strength: Complex) -> Array:
        """Return each touch's weight in the field, shape (n, 2 * channels)."""
        factor = cho_factor(self._system(b, strength).T, lower=True, overwrite_a=True, check_finite=False)
        solved = cho_solve(factor, self.targets(b, strength), check_finite=False)
        return np.ascontiguousarray(solved, dtype=np.float32)

    def at(self, b: int, weights: Array, places_mm: Floats) -> Complex:
        """Return the field (m, channels) at places (m, 2), ADC counts."""
        kernel, rows = self.kernel(b), 512
        field = np.empty((len(places_mm), weights.shape[1]), np.float32)
        for start in range(0, len(places_mm), rows):
            apart_mm = distances(places_mm[start : start + rows], self.touches.place_mm)
            field[start : start + rows] = kernel(apart_mm) @ weights
        found: Complex = field.view(np.complex64) * np.float32(self.scale[b])
        return found

    def _system(self, b: int, strength: Complex) -> Array:
        system = self.kernel(b)(self.distance_mm)
        system[np.diag_indices(len(system))] += self.penalty(b, strength)
        return system


def smooth(inverse: Array, penalty: Array, targets: Array) -> Array:
    """Return the field (n, 2 * channels) at the touches' own places, for targets at the weights of an inverse."""
    return np.asarray(targets - penalty[:, None] * blas.ssymm(1.0, inverse, targets, lower=1))


def each(work: Callable[[int], T], bins: Iterable[int], tell: Callable[[], None] = lambda: None) -> list[T]:
    """Return the work of each bin, done on all cores, and tell when one is done."""
    results = []
    # One bin a core: threads of the linear algebra beside one another would only wait for each other.
    with threadpool_limits(1), ThreadPoolExecutor(min(os.cpu_count() or 1, MOST_THREADS)) as pool:
        for result in pool.map(work, [int(b) for b in bins]):
            results.append(result)
            tell()
    return results
