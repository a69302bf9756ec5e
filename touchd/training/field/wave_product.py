"""The field as the product of two waves, for touches that are too few to tell it as it stands.

The residual of a touch is what reaches it from the emitter times what reaches each receiver from it (Born's
approximation: one scattering). Either is a wave of the plate, which has far fewer degrees of freedom than their
product: on a plate of radius R about 2 k R instead of A k^2 / pi. So both are found in turn, each by ridge regression
while the other is held (alternating least squares), from covariances of random plane waves. What no product explains,
since a window cuts the reverberation off, is left to the regression of `touchd.training.field.regression`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, lapack, solve_triangular
from scipy.special import j0, j1

from touchd.training.field.kernel import SPREAD, distances
from touchd.training.field.regression import Array, Complex, Floats

Wave = NDArray[np.complex128]

WHITE_SHARE = 0.05
"""Of a wave's power: near fields of edges and discs, white up to a wavenumber wider than the free one."""
BAND_MARGIN = 1.2
LEFT_SHARE = (0.2, 0.1, 0.05, 0.03)
"""Of the signal's power that is taken for no product: lowered in steps, which keeps the search from narrow valleys."""
ROUNDS = (20, 8, 6, 6)
STARTS = 2
CUT = 1e-3
"""Of a wave's variance: what its basis may miss at a touch."""
FAINT = 1e-3
_NODE = 0.01  # rad
_SEED = 0x3A7E5


@dataclass(frozen=True, slots=True)
class Basis:
    """Functions whose sum with random weights of variance 1 is a random wave."""

    wavenumber_per_mm: float
    pivots_mm: Floats
    """Shape (m, 2)."""
    factor: Floats
    """Lower triangle of the Cholesky factor of the covariance at the pivots, shape (m, m)."""
    at_touches: Floats
    """Shape (n, m)."""

    def at(self, places_mm: Floats) -> Floats:
        """Return the functions at places (k, 2), shape (k, m)."""
        near = covariance(distances(places_mm, self.pivots_mm).astype(np.float64), self.wavenumber_per_mm)
        return np.asarray(solve_triangular(self.factor, near.T, lower=True, check_finite=False).T)


@dataclass(frozen=True, slots=True)
class Product:
    """The two waves of a bin: weights of the basis."""

    basis: Basis
    emitter: Wave
    """Shape (m, 1)."""
    receivers: Wave
    """Shape (m, channels), ADC counts."""
    left: float
    """Share of the touches' power that is not explained."""

    def at(self, places_mm: Floats) -> Complex:
        """Return the field (k, channels) at places (k, 2), ADC counts."""
        return self._of(self.basis.at(places_mm))

    def at_touches(self) -> Complex:
        """Return the field (n, channels) where the touches are."""
        return self._of(self.basis.at_touches)

    def _of(self, functions: Floats) -> Complex:
        return np.asarray(_sum(functions, self.emitter) * _sum(functions, self.receivers), np.complex64)


def covariance(distance_mm: Floats, wavenumber_per_mm: float) -> Floats:
    """Return that of a wave at distances (mm) of any shape, 1 at 0; by linear interpolation, right to 1e-5."""
    nodes_mm = np.arange(0.0, distance_mm.max(initial=0.0) + 2 * _NODE / wavenumber_per_mm, _NODE / wavenumber_per_mm)
    near = wavenumber_per_mm * np.linspace(1 - SPREAD, 1 + SPREAD, 5)
    free = sum(j0(k * nodes_mm) for k in near) / len(near)
    at = np.maximum(BAND_MARGIN * wavenumber_per_mm * nodes_mm, 1e-9)
    table = (1 - WHITE_SHARE) * free + WHITE_SHARE * 2 * j1(at) / at
    return np.asarray(np.interp(distance_mm, nodes_mm, table))


def basis_of(place_mm: Floats, wavenumber_per_mm: float) -> Basis:
    """Return the functions that waves at some touches (n, 2) are sums of, by a Cholesky factor with pivots."""
    system = covariance(distances(place_mm, place_mm).astype(np.float64), wavenumber_per_mm)
    factor, order, rank, _ = lapack.dpstrf(system, tol=CUT, lower=1)
    factor, order = np.tril(factor)[:, :rank], order - 1
    at_touches = np.empty_like(factor)
    at_touches[order] = factor
    return Basis(wavenumber_per_mm, place_mm[order[:rank]], np.ascontiguousarray(factor[:rank]), at_touches)


def product_of(basis: Basis, values: Complex, strength: Complex, noise: float, start: Product | None = None) -> Product:
    """Return the product that explains touches best.

    Parameters
    ----------
    basis : Basis
    values : array, shape (n, channels)
        The touches in a bin, ADC counts.
    strength : array, shape (n,)
    noise : float
        Variance of the noise in each value.
    start : Product, optional
        From which to go on; else the best of several random ones is taken.
    """
    weight = np.maximum(np.square(np.abs(strength)), 1e-2)
    unit = values.astype(np.complex128) / strength[:, None]
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
        heard = _sum(functions, receivers)
        right = weight[:, None] * (heard.conj() * unit).sum(axis=1, keepdims=True)
        emitter = _solve(functions, weight * np.square(np.abs(heard)).sum(axis=1), right, ridge)
    left = np.square(np.abs(unit - _sum(functions, emitter) * heard))
    return Product(basis, emitter, scale * receivers, float(left.sum() / np.square(np.abs(unit)).sum()))


def _solve(functions: Array, weight: Floats, right: Wave, ridge: float) -> Wave:
    """Return the weights of the functions by ridge regression of right / weight, with that weight."""
    weighted = np.sqrt(weight)[:, None].astype(np.float32) * functions
    gram = weighted.T @ weighted
    gram[np.diag_indices(len(gram))] += np.float32(ridge)
    factor = cho_factor(gram, lower=True, check_finite=False)
    targets = functions.T @ np.ascontiguousarray(right).view(np.float64).astype(np.float32)
    return _complex(cho_solve(factor, targets, check_finite=False))


def _sum(functions: NDArray[np.floating], weights: Wave) -> Wave:
    """Return the sums of functions (n, m) with weights (m, k), without a complex copy of the functions."""
    return _complex(functions @ weights.view(np.float64).astype(functions.dtype))


def _complex(pairs: NDArray[np.floating]) -> Wave:
    return np.ascontiguousarray(pairs, dtype=np.float64).view(np.complex128)
