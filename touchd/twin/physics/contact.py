"""Compliant contacts: a face of soft tissue that follows the wave under it instead of averaging it.

The face is a patchwork of discs. Each has the radiation impedance of its area, and two of areas A at a distance r are
coupled through the tissue, a fluid half-space, by i omega rho A^2 exp(-i k r) / (2 pi r), averaged over both (Kinsler &
Frey, Fundamentals of Acoustics, for sources small against the wave). The plate's deflection over the face is expanded
in polynomials of its position, so that a contact is six or ten coupled forces instead of one a disc.

A fluid carries no shear and the face follows the plate everywhere: skin ridges, friction and bone are left out.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.twin.physics.finger import Contact, impedance, is_compliant, piston, tissue_of

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

RINGS = 3
"""Rings of the hexagonal patchwork around its middle disc: 37 discs change the signal as 91 do, to 2 % of the touch."""
COMPLIANT_FREQUENCIES, RIGID_FREQUENCIES = 12, 24
"""Chebyshev's points at which an impedance is computed; between them it is interpolated to 1e-8, and to 1e-13."""
DEGREES_MM2 = ((70.0, 2), (np.inf, 3))
"""Degree of the polynomials by contact area: a higher one changes the signal by under 1 % of the touch."""


class Face(NamedTuple):
    """Where a contact pushes on the plate: p discs, combined to K forces."""

    centres_mm: Floats
    """Shape (p, 2)."""
    disc_mm2: float
    """Area of each disc."""
    weights: Floats
    """Each force's deflection as a combination of the discs', shape (K, p)."""


def face_of(contact: Contact) -> Face:
    """Return the discs of a contact; a rigid one is a single disc."""
    at = np.array([[contact.x_mm, contact.y_mm]])
    if not is_compliant(contact.kind):
        return Face(at, contact.area_mm2, np.ones((1, 1)))
    return Face(
        at + _on_face_mm(contact, _discs()), contact.area_mm2 / len(_discs()), _basis(_degree(contact.area_mm2)).T
    )


def reach_mm(area_mm2: Floats, ratio: Floats, angle_rad: Floats) -> Floats:
    """Return how far the discs of faces (...) reach from their middles along x and y, (..., 2): beyond the ellipse."""
    long, short = np.sqrt(area_mm2 * ratio / np.pi), np.sqrt(area_mm2 / ratio / np.pi)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    ellipse = np.stack([np.hypot(long * cos, short * sin), np.hypot(long * sin, short * cos)], axis=-1)
    disc = np.sqrt(area_mm2 / len(_discs()) / np.pi)
    return np.asarray(np.hypot(*_discs().T).max() * ellipse + disc[..., None])


def size_of(contact: Contact) -> int:
    """Return the number K of coupled forces of a contact."""
    if not is_compliant(contact.kind):
        return 1
    degree = _degree(contact.area_mm2)
    return (degree + 1) * (degree + 2) // 2


def impedance_of(contact: Contact, omega_rad_s: Complex) -> Complex:
    """Return the impedance of a contact between its forces, N s/m, shape (F, K, K), at angular frequencies (F,).

    Time goes as exp(i omega t).
    """
    if not is_compliant(contact.kind):
        return np.asarray(impedance(contact.kind, omega_rad_s, contact.area_mm2))[:, None, None]
    steps, which = _steps(_degree(contact.area_mm2))
    return np.tensordot(_by_step(contact, steps, omega_rad_s), which, 1)


def _by_step(contact: Contact, steps: Floats, omega_rad_s: Complex) -> Complex:
    """Return the impedance between discs of a face that are some steps (s, 2) apart, N s/m, shape (F, s)."""
    tissue, disc_mm2 = tissue_of(contact.kind), contact.area_mm2 / len(_discs())
    apart_m = 1e-3 * np.linalg.norm(_on_face_mm(contact, steps), axis=1)
    apart_m[0] = 1.0
    omega = omega_rad_s[:, None]
    k = omega / tissue.c_m_s
    z = 1j * omega * tissue.rho_kg_m3 * (disc_mm2 * 1e-6) ** 2 * np.exp(-1j * k * apart_m) / (2 * np.pi * apart_m)
    # A disc's mean is its middle plus r^2 / 8 of the Laplacian in the plane, at both ends of the way.
    z = z * (1 + disc_mm2 * 1e-6 / (4 * np.pi) * (1 / apart_m**2 + 1j * k / apart_m - k**2))
    z[:, 0] = piston(omega_rad_s, disc_mm2, tissue)
    return np.asarray(z)


def _on_face_mm(contact: Contact, points: Floats) -> Floats:
    """Map points of the unit disc to the contact's ellipse about its middle, shape (n, 2)."""
    stretch = np.array([np.sqrt(contact.ratio), 1 / np.sqrt(contact.ratio)])
    x, y = (np.sqrt(contact.area_mm2 / np.pi) * stretch * points).T
    cos, sin = np.cos(contact.angle_rad), np.sin(contact.angle_rad)
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)


@cache
def _lattice() -> NDArray[np.int64]:
    """Return the steps along the two axes of a hexagonal lattice from its middle to each disc, shape (p, 2)."""
    row = np.arange(-RINGS, RINGS + 1)
    q, r = (grid.ravel() for grid in np.meshgrid(row, row))
    inside: NDArray[np.int64] = np.stack([q, r], axis=1)[np.abs(q + r) <= RINGS]
    return inside


@cache
def _discs() -> Floats:
    """Return the middles of a hexagonal patchwork of equal discs with the area of the unit disc, shape (p, 2)."""
    return _points(_lattice())


@cache
def _steps(degree: int) -> tuple[Floats, Floats]:
    """Return the s distinct steps between discs, (s, 2), the first one zero, and how they add to forces, (s, K, K).

    That is the sum over all pairs of discs that a step leads from one to the other of the forces' weights at both.
    """
    lattice = _lattice()
    apart = (lattice[:, None] - lattice).reshape(-1, 2)
    apart *= np.where((apart[:, :1] < 0) | ((apart[:, :1] == 0) & (apart[:, 1:] < 0)), -1, 1)
    distinct, which = np.unique(apart, axis=0, return_inverse=True)
    assert not distinct[0].any()
    basis = _basis(degree)
    pairs = (basis[:, None, :, None] * basis[None, :, None, :]).reshape(len(apart), *basis.shape[1:] * 2)
    forces = np.zeros((len(distinct), *pairs.shape[1:]))
    np.add.at(forces, which.reshape(-1), pairs)
    return _points(distinct), forces


def _points(lattice: NDArray[np.int64]) -> Floats:
    q, r = lattice.T
    unit = np.sqrt(len(_lattice()) * np.sqrt(0.75) / np.pi)
    return np.asarray(np.stack([q + r / 2, np.sqrt(0.75) * r], axis=1) / unit)


@cache
def _basis(degree: int) -> Floats:
    """Return polynomials up to a degree at the discs, orthonormal over them, shape (p, K)."""
    x, y = _discs().T
    powers = [(i - j, j) for i in range(degree + 1) for j in range(i + 1)]
    return np.asarray(np.linalg.qr(np.stack([x**i * y**j for i, j in powers], axis=1))[0])


def _degree(area_mm2: float) -> int:
    return next(degree for most_mm2, degree in DEGREES_MM2 if area_mm2 <= most_mm2)
