"""Covariance of the residual field at two positions: the prior of the kernel ridge regression.

The field of a bin is the product of two waves of the plate. Far from the edges each wave is a random sum of plane waves
from all directions, with covariance J0(k r) over a distance r (Berry, J. Phys. A 10:2083, 1977). Their product has the
covariance J0(k r)^2, without spatial frequencies above 2 k. A small white share within that band, 2 J1(K r) / (K r),
covers near fields of edges and discs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.special import j0, j1

Array = NDArray[np.float32]
Floats = NDArray[np.float64]

BAND_MARGIN = 1.15
"""Factor by which the white share's band exceeds that of the waves."""
WHITE_SHARE = 0.05
SPREAD = 0.02
"""Relative spread of the wavenumber: the dispersion is inexact, and a bin has a bandwidth."""
_NODES = 200  # per unit of 2 k r: linear interpolation to 1e-6, else the matrix is not positive definite
_ROWS = 64  # a block of this many rows fits the cache


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


def distances(one_mm: Floats, other_mm: Floats) -> Array:
    """Return the distances (n, m) between positions (n, 2) and (m, 2), mm."""
    return cdist(one_mm, other_mm).astype(np.float32)


def _line(table: Floats) -> tuple[Array, Array]:
    return table.astype(np.float32), np.diff(table, append=table[-1]).astype(np.float32)
