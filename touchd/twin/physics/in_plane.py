"""Waves in the plate's own plane, beside its bending waves: a disc on one face drives and senses both.

A disc stretches at its height over the plate's middle, where that is a moment and a force. The latter starts the
symmetric Lamb wave S0 and, at the edges, the shear wave SH0. What touches the plate lightly pushes across it and leaves
them as they are, so that they are in the untouched response alone: on 5 mm of glass with discs of 6 mm 0.9 % of its
energy, with 15 mm 8 % (three-dimensional elasticity).

Displacements u and v in the middle are sums of products of Legendre polynomials, as in `touchd.twin.physics.plate`; the
energies are those of plane stress, and of the motion across by which a plate gets thinner where it is stretched (Love's
correction): on 6 mm of acrylic S0 is 5 % slower for it at 100 kHz.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Plate
from touchd.twin.physics import corners, legendre
from touchd.twin.physics.material import corner_radius_m, material_of
from touchd.twin.physics.plate import LEAST_MARGIN, ClassModes, Modes, modes_of, size_m

Floats = NDArray[np.float64]


def polynomials_for(plate: Plate, frequency_hz: float) -> tuple[int, int]:
    """Return the polynomials along x and y that resolve these waves up to a frequency: shear's are the shortest."""
    m = material_of(plate)
    k = 2 * np.pi * frequency_hz * np.sqrt(2 * (1 + m.nu) * m.rho_kg_m3 / m.E_pa)
    nx, ny = (2 * int(np.ceil((k * length / 2 + LEAST_MARGIN) / 2)) for length in size_m(plate))
    return nx, ny


def solve_classes(plate: Plate, counts: tuple[int, int], below_hz: float = np.inf) -> list[ClassModes]:
    """Solve for the modes of a plate with free edges under a frequency, parity by parity: of u along x and y.

    As bending modes have them they hold a deflection, which is nothing, and u and v in the place of the rotations.
    """
    return [_solve_class(plate, counts, px, py, below_hz) for px in (0, 1) for py in (0, 1)]


def solve(plate: Plate, frequency_hz: float, counts: tuple[int, int], below_hz: float) -> Modes:
    """Return the modes as bending ones have them: without a deflection, with u and v in the place of rotations.

    They resolve waves up to `frequency_hz` and are kept `below_hz`, in any order; `counts` are the polynomials.
    """
    classes = solve_classes(plate, polynomials_for(plate, frequency_hz), below_hz)
    fields = []
    for each in classes:
        found = np.zeros((3, len(each.omega_rad_s), *counts))
        for field, values, (along_x, along_y) in zip(found, each.fields, each.places, strict=True):
            field[:, along_x, along_y] = values
        fields.append(found)
    return Modes(np.concatenate([each.omega_rad_s for each in classes]), *np.concatenate(fields, axis=1))


def _solve_class(plate: Plate, counts: tuple[int, int], px: int, py: int, below_hz: float) -> ClassModes:
    """Solve for the modes whose u has parity px in x and py in y (0 even, 1 odd); v has the others."""
    m, (nx, ny) = material_of(plate), counts
    dx, dy = (legendre.derivative(side, count) for side, count in zip(size_m(plate), counts, strict=True))
    ux, uy, vx, vy = slice(px, nx, 2), slice(py, ny, 2), slice(1 - px, nx, 2), slice(1 - py, ny, 2)
    ux_x, uy_y, vx_x, vy_y = dx[vx, ux], dy[vy, uy], dx[ux, vx], dy[uy, vy]
    shapes = [(ux_x.shape[1], uy_y.shape[1]), (vx_x.shape[1], vy_y.shape[1])]
    along_x, along_y, between, shear = (stiffness / m.rho_kg_m3 for stiffness in m.in_plane())
    across_m2 = (m.nu / (1 - m.nu)) ** 2 * (plate.thickness_mm * 1e-3) ** 2 / 12
    of_u = int(np.prod(shapes[0]))
    K = np.zeros((of_u + int(np.prod(shapes[1])),) * 2)
    K[:of_u, :of_u] = np.kron(along_x * ux_x.T @ ux_x, np.eye(shapes[0][1]))
    K[:of_u, :of_u] += np.kron(np.eye(shapes[0][0]), shear * uy_y.T @ uy_y)
    K[of_u:, of_u:] = np.kron(np.eye(shapes[1][0]), along_y * vy_y.T @ vy_y)
    K[of_u:, of_u:] += np.kron(shear * vx_x.T @ vx_x, np.eye(shapes[1][1]))
    K[of_u:, :of_u] = between * np.kron(ux_x, vy_y.T) + shear * np.kron(vx_x.T, uy_y)
    divergence = np.hstack([np.kron(ux_x, np.eye(shapes[0][1])), np.kron(np.eye(shapes[1][0]), vy_y)])
    mass = across_m2 * divergence.T @ divergence
    mass[np.diag_indices(len(mass))] += 1
    K[:of_u, of_u:] = K[of_u:, :of_u].T
    if radius_m := corner_radius_m(plate):
        points = corners.pieces(radius_m, size_m(plate), counts)
        a, b = corners.products(points, size_m(plate), counts, ((ux, uy), (vx, vy)))
        K -= sum(row.T @ row for row in corners.in_plane_rows(a, b, (along_x, along_y, between, shear)))
        thinner = np.hstack([a[1], b[2]])
        mass -= across_m2 * thinner.T @ thinner
        mass[:of_u, :of_u] -= a[0].T @ a[0]
        mass[of_u:, of_u:] -= b[0].T @ b[0]
    squared, vectors = modes_of(K, mass)
    omega = np.sqrt(np.maximum(squared, 0.0))
    if (px, py) != (1, 0):
        omega[0] = 0.0  # a rigid motion: along x or y, or a turn
    kept = omega < 2 * np.pi * below_hz
    # Unit modal mass.
    u, v = np.split(vectors[:, kept].T * (m.rho_kg_m3 * plate.thickness_mm * 1e-3) ** -0.5, [of_u], axis=1)
    nowhere = slice(0, 0), slice(0, 0)
    fields = np.zeros((len(u), 0, 0)), u.reshape(-1, *shapes[0]), v.reshape(-1, *shapes[1])
    return ClassModes(omega[kept], fields, (nowhere, (ux, uy), (vx, vy)))
