"""Rounded corners: the rectangle's energies less those of the four pieces between an arc and its corner.

Free edges are the natural boundary conditions of Ritz's method, so the arc needs no other functions: only the pieces
are left out of the integrals. A small share of each piece stays, plate of the same kind but lighter and softer, without
which functions that live there alone have neither mass nor stiffness (the finite cell method: Parvizian, Duester and
Rank, Comput. Mech. 41, 2007).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.twin.physics import legendre

Floats = NDArray[np.float64]

STAYS = 1e-5
"""Share of each piece's mass and stiffness that stays."""
RADIAL, ANGULAR = 6, 10
"""Points of Gauss' rules across and along half a piece, beside those that the polynomials' waves need."""


class Points(NamedTuple):
    """Points of the piece at the corner of least x and y, Q of them."""

    x_m: Floats
    y_m: Floats
    weights: Floats
    """What integrals over all four pieces take of each point, of fields that are even or odd across the middle."""

    def on_unit_square(self, size_m: tuple[float, float]) -> Points:
        """Return the same points and weights in coordinates scaled by width and height."""
        width, height = size_m
        return Points(self.x_m / width, self.y_m / height, self.weights / (width * height))


def inside(position: Floats, size: Floats, radius: float, margin: float = 0.0) -> tuple[Floats, Floats]:
    """Return places (n, 2), moved onto a plate and `margin` from its edge, and their way to that line, (n,).

    All lengths are in one unit.
    """
    size, radius = size - 2 * margin, max(radius - margin, 0.0)
    core, apart = size / 2 - radius, position - margin - size / 2
    over = np.abs(apart) - core
    out = np.maximum(over, 0.0)
    length = np.hypot(*out.T)
    back = np.minimum(radius / np.maximum(length, 1e-12), 1.0)[:, None]
    moved = np.copysign(np.where(over > 0, core + back * out, np.abs(apart)), apart)
    edge = radius - length - np.minimum(over.max(axis=1), 0.0)
    return margin + size / 2 + moved, np.maximum(edge, 0.0)


def pieces(radius_m: float, size_m: tuple[float, float], counts: tuple[int, int]) -> Points:
    """Return the rule of integrals over the pieces, m^2, of squares of sums of so many polynomials along each side."""
    waves = _waves(radius_m, size_m, counts)
    angle, of_angle = _gauss(0.0, np.pi / 4, ANGULAR + 5 * waves // 2)
    across, of_across = _gauss(0.0, 1.0, RADIAL + 3 * waves // 2)
    wide = 1 / np.cos(angle) - 1
    out = 1 + across[:, None] * wide  # from the arc's centre to the side, in radii
    area = of_across[:, None] * of_angle * wide * out
    return _both(radius_m * (1 - out * np.cos(angle)), radius_m * (1 - out * np.sin(angle)), radius_m**2 * area)


def arcs(radius_m: float, size_m: tuple[float, float], counts: tuple[int, int]) -> Points:
    """Return the rule of the derivative of these integrals by the logarithm of the radius, m^2."""
    angle, of_angle = _gauss(0.0, np.pi / 4, ANGULAR + 2 * _waves(radius_m, size_m, counts))
    x, y = 1 - np.cos(angle), 1 - np.sin(angle)
    # As the radius grows, the centre moves inwards along both sides, and the arc with it.
    return _both(radius_m * x, radius_m * y, radius_m**2 * of_angle * (1 - x - y))


def _waves(radius_m: float, size_m: tuple[float, float], counts: tuple[int, int]) -> int:
    """Return how many half waves the highest polynomials have within the radius: towards the ends they get shorter."""
    return max(
        int(np.arccos(max(1 - 2 * radius_m / side, -1.0)) / np.pi * count) + 1
        for side, count in zip(size_m, counts, strict=True)
    )


def _gauss(low: float, high: float, count: int) -> tuple[Floats, Floats]:
    node, weight = np.polynomial.legendre.leggauss(count)
    return low + (high - low) * (node + 1) / 2, (high - low) / 2 * weight


def _both(x: Floats, y: Floats, area: Floats) -> Points:
    """Return the points of half a piece, and of the other half, the same across the diagonal."""
    x, y, area = x.ravel(), y.ravel(), area.ravel()
    weights = 4 * (1 - STAYS) * np.concatenate([area, area])
    return Points(np.concatenate([x, y]), np.concatenate([y, x]), weights)


def products(
    points: Points, size_m: tuple[float, float], counts: tuple[int, int], places: Sequence[tuple[slice, slice]]
) -> list[Floats]:
    """Return products of polynomials, for each field those of its `places`, times the roots of the points' weights.

    Each is value and slopes along x and y, shape (3, Q, a b).
    """
    x, y = (
        legendre.values(at, side, count)
        for at, side, count in zip((points.x_m, points.y_m), size_m, counts, strict=True)
    )
    dx, dy = (each @ legendre.derivative(side, count) for each, side, count in zip((x, y), size_m, counts, strict=True))
    root = np.sqrt(points.weights)[:, None]
    found = []
    for along_x, along_y in places:
        pairs = (x, y), (dx, y), (x, dy)
        found.append(np.stack([
            ((root * a[:, along_x])[:, :, None] * b[:, None, along_y]).reshape(len(root), -1) for a, b in pairs
        ]))  # fmt: skip
    return found


def in_plane_rows(a: Floats, b: Floats, stiffness: tuple[float, float, float, float]) -> list[Floats]:
    """Return rows whose squares sum to the strain energy of fields along x and y, of the plate's plane stress.

    `a` and `b` are `products` of both, and `stiffness` as of `Material.in_plane`.
    """
    along_x, along_y, between, shear = stiffness
    root = np.linalg.cholesky(np.array([[along_x, between], [between, along_y]]))
    x_x, y_y = np.hstack([a[1], np.zeros_like(b[1])]), np.hstack([np.zeros_like(a[2]), b[2]])
    sheared = np.hstack([a[2], b[1]])
    return [root[0, 0] * x_x + root[1, 0] * y_y, root[1, 1] * y_y, np.sqrt(shear) * sheared]
