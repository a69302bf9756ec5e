"""Fit the field as the product of two waves, for touches too few for a regression of the field itself.

The residual of a touch is the wave from the emitter to it times the wave from it to each receiver (Born approximation:
single scattering). Each wave has far fewer degrees of freedom than their product: about 2 k R on a plate of radius R,
instead of A k^2 / pi. Alternating least squares fits one wave by ridge regression while the other is fixed, with the
covariance of random plane waves. The window cuts reverberation off, so a product cannot explain everything; the rest
goes to `touchd.training.field.regression`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, lapack, solve_triangular

from touchd.training.field import kernel
from touchd.training.field.kernel import distances
from touchd.training.field.regression import Array, Complex, Floats

Wave = NDArray[np.complex128]

WHITE_SHARE = 0.05
"""Share of a wave's power in near fields of edges and discs, white up to `BAND_MARGIN` times the wavenumber."""
BAND_MARGIN = 1.2
LEFT_SHARE = (0.2, 0.1, 0.05, 0.03)
"""Share of the signal's power assumed to be no product; decreasing steps avoid narrow valleys."""
ROUNDS = (20, 8, 6, 6)
STARTS = 2
CUT = 1e-3
"""Share of a wave's variance that its basis may miss at a touch."""
_NODE = 0.01  # rad
_SEED = 0x3A7E5


@dataclass(frozen=True, slots=True)
class Basis:
    """Functions whose sum with random weights of unit variance is a random wave."""

    wavenumber_per_mm: float
    pivots_mm: Floats
    """Shape (m, 2)."""
    factor: Floats
    """Lower triangle of the Cholesky factor of the covariance at the pivots, shape (m, m)."""
    at_touches: Floats
    """Shape (n, m)."""

    def at(self, positions_mm: Floats) -> Floats:
        """Evaluate the functions at positions (k, 2), shape (k, m)."""
        near = covariance(distances(positions_mm, self.pivots_mm).astype(np.float64), self.wavenumber_per_mm)
        return np.asarray(solve_triangular(self.factor, near.T, lower=True, check_finite=False).T)


@dataclass(frozen=True, slots=True)
class Product:
    """The two waves of a bin, as weights of the basis."""

    basis: Basis
    emitter: Wave
    """Shape (m, 1)."""
    receivers: Wave
    """Shape (m, channels), ADC counts."""
    left: float
    """Share of the touches' power that the product does not explain."""

    def at(self, positions_mm: Floats) -> Complex:
        """Evaluate the field (k, channels) at positions (k, 2), ADC counts."""
        return self._of(self.basis.at(positions_mm))

    def at_touches(self) -> Complex:
        """Return the field (n, channels) at the touches, ADC counts."""
        return self._of(self.basis.at_touches)

    def _of(self, functions: Floats) -> Complex:
        return np.asarray(_sum(functions, self.emitter) * _sum(functions, self.receivers), np.complex64)


def covariance(distance_mm: Floats, wavenumber_per_mm: float) -> Floats:
    """Return a wave's covariance at distances (mm) of any shape, 1 at 0; linear interpolation, error 1e-5."""
    at = np.asarray(distance_mm * (wavenumber_per_mm / _NODE), np.float64)
    below = at.astype(np.intp)  # by its index: to search for each distance took half of a training on few touches
    nodes_mm = np.arange(below.max(initial=0) + 2) * (_NODE / wavenumber_per_mm)
    table = kernel.covariance(nodes_mm, wavenumber_per_mm, WHITE_SHARE, waves=1, margin=BAND_MARGIN)
    at -= below
    return np.asarray(table[below] + at * np.diff(table)[below])


def basis_of(position_mm: Floats, wavenumber_per_mm: float) -> Basis:
    """Return the basis of waves at touches (n, 2), by a pivoted Cholesky factor."""
    system = covariance(distances(position_mm, position_mm).astype(np.float64), wavenumber_per_mm)
    factor, order, rank, _ = lapack.dpstrf(system, tol=CUT, lower=1)
    factor, order = np.tril(factor)[:, :rank], order - 1
    at_touches = np.empty_like(factor)
    at_touches[order] = factor
    return Basis(wavenumber_per_mm, position_mm[order[:rank]], np.ascontiguousarray(factor[:rank]), at_touches)


def product_of(
    basis: Basis, values: Complex, amplitude: Complex, noise: float, start: Product | None = None
) -> Product:
    """Fit the product of two waves to the touches (n, channels) of a bin, ADC counts.

    `amplitude`, of shape (n,), is that of each touch, `noise` the variance of each value. The fit begins at `start`, by
    default at the best of several random starts.
    """
    weight = np.maximum(np.square(np.abs(amplitude)), 1e-2)
    unit = values.astype(np.complex128) / amplitude[:, None]
    scale = float(np.sqrt(np.mean(np.square(np.abs(unit)))))
    unit /= scale
    noise /= scale**2
    if start is not None:
        return _alternate(basis, unit, weight, noise, scale, start.emitter, slice(-1, None))
    random = np.random.default_rng(_SEED)
    size = (STARTS, basis.at_touches.shape[1], 1)
    starts = random.normal(size=size) + 1j * random.normal(size=size)
    tried = [_alternate(basis, unit, weight, noise, scale, one, slice(None)) for one in starts]
    return min(tried, key=lambda product: product.left)


def _alternate(
    basis: Basis, unit: Wave, weight: Floats, noise: float, scale: float, emitter: Wave, steps: slice
) -> Product:
    functions = basis.at_touches.astype(np.float32)
    shares = [share for share, rounds in list(zip(LEFT_SHARE, ROUNDS, strict=True))[steps] for _ in range(rounds)]
    for share in shares:
        ridge = noise + share
        sent = _sum(functions, emitter)
        sent /= np.sqrt(np.mean(np.square(np.abs(sent))))
        right = weight[:, None] * sent.conj() * unit
        receivers = _solve(functions, weight * np.square(np.abs(sent[:, 0])), right, ridge)
        received = _sum(functions, receivers)
        right = weight[:, None] * (received.conj() * unit).sum(axis=1, keepdims=True)
        emitter = _solve(functions, weight * np.square(np.abs(received)).sum(axis=1), right, ridge)
    left = np.square(np.abs(unit - _sum(functions, emitter) * received))
    return Product(basis, emitter, scale * receivers, float(left.sum() / np.square(np.abs(unit)).sum()))


def _solve(functions: Array, weight: Floats, right: Wave, ridge: float) -> Wave:
    """Solve the ridge regression of right / weight, with this weight, for the functions' weights."""
    weighted = np.sqrt(weight)[:, None].astype(np.float32) * functions
    gram = weighted.T @ weighted
    gram[np.diag_indices(len(gram))] += np.float32(ridge)
    factor = cho_factor(gram, lower=True, check_finite=False)
    targets = functions.T @ np.ascontiguousarray(right).view(np.float64).astype(np.float32)
    return _complex(cho_solve(factor, targets, check_finite=False))


def _sum(functions: NDArray[np.floating], weights: Wave) -> Wave:
    """Return functions (n, m) @ weights (m, k), without a complex copy of the functions."""
    return _complex(functions @ weights.view(np.float64).astype(functions.dtype))


def _complex(pairs: NDArray[np.floating]) -> Wave:
    return np.ascontiguousarray(pairs, dtype=np.float64).view(np.complex128)
