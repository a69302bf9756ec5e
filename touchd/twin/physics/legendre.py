"""Orthonormal Legendre polynomials on an interval, and their averages over discs and rims."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def values(position_m: ArrayLike, length_m: float, count: int) -> Floats:
    """Orthonormal Legendre polynomials of degrees 0 .. count - 1 on [0, length_m].

    Shape (*position_m.shape, count), in m^-1/2: the integral of the square of each is 1.
    """
    xi = 2 * np.asarray(position_m, dtype=float) / length_m - 1
    p = np.empty((count, *xi.shape))
    p[0] = 1.0
    if count > 1:
        p[1] = xi
    for i in range(2, count):
        p[i] = ((2 * i - 1) * xi * p[i - 1] - (i - 1) * p[i - 2]) / i
    norm = np.sqrt((2 * np.arange(count) + 1) / length_m)
    return np.moveaxis(p, 0, -1) * norm


def derivative(length_m: float, count: int) -> Floats:
    """Matrix d of shape (count, count), in 1/m: the derivative of polynomial j is the sum over i of d[i, j] times i.

    From P_j' = sum of (2i + 1) P_i over i = j - 1, j - 3, ...
    """
    i, j = np.indices((count, count))
    d = np.sqrt((2.0 * i + 1) * (2.0 * j + 1)) * 2 / length_m
    return np.where((i < j) & ((i + j) % 2 == 1), d, 0.0)


@cache
def disc_rule(radial: int, angular: int) -> tuple[Floats, Floats, Floats]:
    """Points of the unit disc and weights that sum to 1: Gauss in radius squared, equal steps in angle."""
    node, weight = np.polynomial.legendre.leggauss(radial)
    radius = np.sqrt((node + 1) / 2)
    step = np.arange(angular) / angular
    # Turning every second ring by half a step doubles the angular order at no cost.
    angle = 2 * np.pi * (step[None, :] + (np.arange(radial)[:, None] % 2) / (2 * angular))
    x = radius[:, None] * np.cos(angle)
    y = radius[:, None] * np.sin(angle)
    w = np.repeat(weight / 2 / angular, angular)
    return x.ravel(), y.ravel(), w


def disc_average(
    centre_m: ArrayLike,
    radius_m: ArrayLike,
    size_m: tuple[float, float],
    counts: tuple[int, int],
    rule: tuple[int, int] = (3, 8),
) -> Floats:
    """Averages of the products of polynomials over discs of centres (n, 2) and radii (n,); shape (n, *counts), 1/m.

    `size_m` is width and height of the plate, `counts` are the polynomials along x and y, `rule` is the number of rings
    and of points of each: 3 rings of 8 are exact to 1e-8 while the disc is under a third of a wavelength.
    """
    x, y, w = disc_rule(*rule)
    (found,) = _weighed(centre_m, radius_m, size_m, counts, (x, y), w)
    return found


def disc_moments(
    centre_m: ArrayLike, radius_m: ArrayLike, size_m: tuple[float, float], counts: tuple[int, int]
) -> tuple[Floats, Floats]:
    """Averages over discs of the products times the distance from the centre along x and y, over half the radius.

    Two arrays as `disc_average` has them. A disc's mass times their squares is its part in the kinetic energy that the
    mean deflection leaves out, as far as the deflection is linear there.
    """
    x, y, w = disc_rule(4, 12)
    first, second = _weighed(centre_m, radius_m, size_m, counts, (x, y), 2 * x * w, 2 * y * w)
    return first, second


def _weighed(
    centre_m: ArrayLike,
    radius_m: ArrayLike,
    size_m: tuple[float, float],
    counts: tuple[int, int],
    points: tuple[Floats, Floats],
    *weights: Floats,
) -> list[Floats]:
    """Return, for each of some weights, the sum over points of the unit disc, x and y, times these."""
    centre = np.asarray(centre_m, dtype=float)
    radius = np.asarray(radius_m, dtype=float)
    x, y = points
    px = values(centre[:, 0, None] + radius[:, None] * x, size_m[0], counts[0])
    py = values(centre[:, 1, None] + radius[:, None] * y, size_m[1], counts[1])
    return [np.asarray((px * w[:, None]).transpose(0, 2, 1) @ py) for w in weights]


def rim_average(
    centre_m: ArrayLike, radius_m: ArrayLike, size_m: tuple[float, float], counts: tuple[int, int]
) -> tuple[Floats, Floats]:
    """Averages around rims of the products of polynomials times the outward normal's x and y.

    Two arrays of shape (..., *counts), in 1/m, for centres (..., 2) and radii (...) or (); other parameters as in
    `disc_average`.
    """
    centre, radius = (np.asarray(each, dtype=float)[..., None] for each in (centre_m, radius_m))
    angle = 2 * np.pi * np.arange(32) / 32
    px = values(centre[..., 0, :] + radius * np.cos(angle), size_m[0], counts[0]).swapaxes(-1, -2)
    py = values(centre[..., 1, :] + radius * np.sin(angle), size_m[1], counts[1])
    return (px * np.cos(angle) / 32) @ py, (px * np.sin(angle) / 32) @ py
