"""Modes of a rectangular Mindlin plate with free edges, by Ritz's method with Legendre polynomials.

Deflection w and rotations psi_x, psi_y are sums of products of orthonormal Legendre polynomials. Free edges are the
natural boundary conditions of the strain energy, so nothing is imposed. The energies are Mindlin's (J. Appl. Mech. 18,
1951), the method is Liew's (J. Sound Vib. 159, 1992).
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.physics import corners, legendre
from touchd.twin.physics.material import corner_radius_m, material_of, mindlin_wavenumber, stiffness_of

Floats = NDArray[np.float64]

MANY_POLYNOMIALS, MOST_POLYNOMIALS = 80, 112
"""A larger eigenproblem takes minutes, or many minutes and gigabytes."""
MARGIN, LEAST_MARGIN = 15, 9
"""Polynomials beyond pi per wavelength: they leave an error of 1e-9 and of 2e-8 at the highest frequency."""


class Modes(NamedTuple):
    """Modes of vibration, normalised to unit modal mass: n modes, in ascending frequency."""

    omega_rad_s: Floats
    """Angular frequencies, shape (n,)."""
    w: Floats
    """Deflection in Legendre products, shape (n, nx, ny)."""
    psi_x: Floats
    """Rotation along x, same shape."""
    psi_y: Floats
    """Rotation along y, same shape."""


Slices = tuple[slice, slice]


class ClassModes(NamedTuple):
    """Modes of one parity, in ascending frequency: three quarters of their coefficients are zero and left out."""

    omega_rad_s: Floats
    """Angular frequencies, shape (n,)."""
    fields: tuple[Floats, Floats, Floats]
    """Coefficients of w, psi_x and psi_y, each (n, a, b)."""
    places: tuple[Slices, Slices, Slices]
    """Where these stand among all, along x and y."""


def size_m(plate: Plate) -> tuple[float, float]:
    """Width and height of a plate in metres."""
    return plate.width_mm * 1e-3, plate.height_mm * 1e-3


def polynomials_for(plate: Plate, frequency_hz: float, margin: int = MARGIN) -> tuple[int, int]:
    """Return the polynomials along x and y that resolve the plate's waves up to a frequency.

    A polynomial basis needs pi per wavelength and a margin that hardly grows; 48 at 100 kHz on 200 mm of 5 mm glass. A
    plate that needs many gets the least margin. Raises SimulationError if the plate is too many wavelengths wide.
    """
    k = float(mindlin_wavenumber(plate, frequency_hz))
    counts = [2 * int(np.ceil((k * length / 2 + margin) / 2)) for length in size_m(plate)]
    if max(counts) > MANY_POLYNOMIALS and margin > LEAST_MARGIN:
        return polynomials_for(plate, frequency_hz, LEAST_MARGIN)
    if max(counts) > MOST_POLYNOMIALS:
        raise SimulationError(
            f"a {plate.width_mm:g} x {plate.height_mm:g} x {plate.thickness_mm:g} mm plate of {plate.material} is "
            f"{k * max(size_m(plate)) / (2 * np.pi):.0f} wavelengths wide",
            "plate",
            f"make it smaller or thicker: {(MOST_POLYNOMIALS - LEAST_MARGIN - 1) / np.pi:.0f} wavelengths at most",
        )
    return counts[0], counts[1]


def solve(plate: Plate, counts: tuple[int, int], below_hz: float = np.inf) -> Modes:
    """Solve for the modes of a plate with free edges under a frequency, with `counts` polynomials along x and y.

    Raises SimulationError if the material is unknown.
    """
    classes = solve_classes(plate, counts, below_hz)
    omega = np.concatenate([each.omega_rad_s for each in classes])
    order = np.argsort(omega, kind="stable")
    rows = np.split(np.argsort(order), np.cumsum([len(each.omega_rad_s) for each in classes])[:-1])
    fields = [np.zeros((len(omega), *counts)) for _ in range(3)]
    for each, own in zip(classes, rows, strict=True):
        for field, values, (along_x, along_y) in zip(fields, each.fields, each.places, strict=True):
            field[own, along_x, along_y] = values
    return Modes(omega[order], *fields)


def modes_of(stiffness: Floats, mass: Floats) -> tuple[Floats, Floats]:
    """Return squares of angular frequencies (n,), and in columns modes of unit mass (n, n), of two matrices (n, n).

    Raises
    ------
    LinAlgError
        If the mass is not positive.
    """
    half = np.linalg.inv(np.linalg.cholesky(mass))
    squares, vectors = np.linalg.eigh(half @ stiffness @ half.T)
    return squares, half.T @ vectors


def solve_classes(plate: Plate, counts: tuple[int, int], below_hz: float = np.inf) -> list[ClassModes]:
    """Solve for the modes, as `solve` does, parity by parity: of the deflection, even or odd along x and y."""
    return [_solve_class(plate, counts, px, py, below_hz) for px in (0, 1) for py in (0, 1)]


def _solve_class(plate: Plate, counts: tuple[int, int], px: int, py: int, below_hz: float) -> ClassModes:
    """Solve for the modes whose deflection has parity px in x and py in y (0 even, 1 odd)."""
    s = stiffness_of(plate)
    nx, ny = counts
    width, height = size_m(plate)
    dx, dy = legendre.derivative(width, nx), legendre.derivative(height, ny)
    # A derivative turns even polynomials into odd ones: psi_x is odd in x where w is even.
    wx, wy, rx, ry = slice(px, nx, 2), slice(py, ny, 2), slice(1 - px, nx, 2), slice(1 - py, ny, 2)
    dx_w, dy_w = dx[rx, wx], dy[ry, wy]  # derivative of w, in the space of psi
    dx_r, dy_r = dx[wx, rx], dy[wy, ry]  # derivative of psi, in the space of w
    places = (wx, wy), (rx, wy), (wx, ry)
    shapes = [(len(range(nx)[i]), len(range(ny)[j])) for i, j in places]
    sizes = [a * b for a, b in shapes]
    b0, b1, b2, b3 = np.cumsum([0, *sizes])
    one = np.eye
    S, cube = s.shear, (plate.thickness_mm * 1e-3) ** 3 / 12
    Dx, Dy, between, twist = (cube * stiffness for stiffness in material_of(plate).in_plane())
    K = np.zeros((b3, b3))
    K[b0:b1, b0:b1] = S * (np.kron(dx_w.T @ dx_w, one(shapes[0][1])) + np.kron(one(shapes[0][0]), dy_w.T @ dy_w))
    K[b1:b2, b1:b2] = np.kron(Dx * dx_r.T @ dx_r + S * one(shapes[1][0]), one(shapes[1][1]))
    K[b1:b2, b1:b2] += twist * np.kron(one(shapes[1][0]), dy_w.T @ dy_w)
    K[b2:b3, b2:b3] = np.kron(one(shapes[2][0]), Dy * dy_r.T @ dy_r + S * one(shapes[2][1]))
    K[b2:b3, b2:b3] += twist * np.kron(dx_w.T @ dx_w, one(shapes[2][1]))
    K[b1:b2, b0:b1] = S * np.kron(dx_w, one(shapes[0][1]))
    K[b2:b3, b0:b1] = S * np.kron(one(shapes[0][0]), dy_w)
    K[b2:b3, b1:b2] = between * np.kron(dx_r, dy_r.T) + twist * np.kron(dx_w.T, dy_w)
    # The mass matrix is diagonal, since the polynomials are orthonormal.
    scale = np.concatenate([np.full(sizes[0], s.mass), np.full(sizes[1] + sizes[2], s.rotary)]) ** -0.5
    K *= scale[:, None] * scale
    if radius_m := corner_radius_m(plate):
        w, x, y = corners.products(corners.pieces(radius_m, size_m(plate), counts), size_m(plate), counts, places)
        bent = corners.in_plane_rows(x, y, (Dx, Dy, between, twist))
        none = np.zeros((len(w[0]), sizes[0]))
        stiff = [np.hstack([none, each]) for each in bent]
        stiff.append(np.sqrt(S) * np.hstack([w[1], x[0], np.zeros_like(y[0])]))
        stiff.append(np.sqrt(S) * np.hstack([w[2], np.zeros_like(x[0]), y[0]]))
        K -= sum((each * scale).T @ (each * scale) for each in stiff)
        K = np.tril(K) + np.tril(K, -1).T
        mass = np.eye(b3)
        for each, (start, stop) in zip((w, x, y), pairwise((b0, b1, b2, b3)), strict=True):
            mass[start:stop, start:stop] -= each[0].T @ each[0]
        squared, vectors = modes_of(K, mass)
    else:
        squared, vectors = np.linalg.eigh(K, UPLO="L")
    omega = np.sqrt(np.maximum(squared, 0.0))
    if not (px and py):
        omega[0] = 0.0  # a rigid motion: up and down, or rocking about an axis; rounding leaves it some millihertz
    kept = omega < 2 * np.pi * below_hz
    vectors = (vectors[:, kept] * scale[:, None]).T
    w, psi_x, psi_y = (
        vectors[:, start:stop].reshape(len(vectors), *shape)
        for (start, stop), shape in zip(((b0, b1), (b1, b2), (b2, b3)), shapes, strict=True)
    )
    return ClassModes(omega[kept], (w, psi_x, psi_y), places)
