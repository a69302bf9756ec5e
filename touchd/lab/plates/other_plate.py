"""Plates by other physics than a fit has: discs with rotary inertia and stiffness in all directions, ribs, holes.

Everything is a patch that adds to the plate's energies, integrated over points: mass and rotary inertia per area, and
bending and shear stiffness. A negative patch takes the plate away.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Plate
from touchd.twin.cache import remember
from touchd.twin.physics import legendre
from touchd.twin.physics.material import material_of, stiffness_of
from touchd.twin.physics.plate import Modes, polynomials_for, size_m, solve
from touchd.twin.physics.transducer import Layout, LoadedModes

Floats = NDArray[np.float64]

VERSION = 1
BASIS, KEPT = 3.0, 2.0
"""Times the band's end: modes that carry the patches, and modes that are kept."""


class Patch(NamedTuple):
    """A disc or rectangle on the plate that adds to its energies."""

    x_mm: float
    y_mm: float
    half_x_mm: float
    half_y_mm: float
    mass_kg_m2: float = 0.0
    rotary_kg: float = 0.0
    bending_n_m: float = 0.0
    shear_n_m: float = 0.0
    round: bool = True
    corner: bool = False
    """Whether it is the triangle towards the rectangle's corner of least x and y."""


def disc_patches(layout: Layout) -> list[Patch]:
    """Return the discs as 2 mm of PZT (7600 kg/m^3, 62 GPa); the bond takes half of their stiffness."""
    radius, density, young, thick = layout.diameter_mm / 2, 7600.0, 62e9, 2e-3
    lever = 3.5e-3
    return [
        Patch(
            float(x), float(y), radius, radius, density * thick, density * thick * lever**2,
            0.5 * young * thick * lever**2 / (1 - 0.3**2),
        )
        for x, y in layout.centres_mm
    ]  # fmt: skip


def missing(plate: Plate, share: float, **where: float | bool) -> Patch:
    """Return a patch that takes a share of the plate away."""
    s = stiffness_of(plate)
    return Patch(
        mass_kg_m2=-share * s.mass, rotary_kg=-share * s.rotary, bending_n_m=-share * s.bending,
        shear_n_m=-share * s.shear, **where,  # type: ignore[arg-type]  # the rest are places
    )  # fmt: skip


def other_modes(plate: Plate, layout: Layout, patches: list[Patch], frequency_hz: float = 100e3) -> LoadedModes:
    """Return the modes of a plate with its discs and other patches; cached on disk."""
    counts = polynomials_for(plate, frequency_hz)
    key = {
        "version": VERSION, "plate": plate.model_dump(), "material": material_of(plate), "counts": counts,
        "layout": layout.model_dump(), "patches": patches, "frequency_hz": frequency_hz,
    }  # fmt: skip

    def compute() -> dict[str, Floats]:
        wide = max(counts) > 80
        modes = _bare(plate, counts, (1.6 if wide else BASIS) * frequency_hz)
        every = [*disc_patches(layout), *patches]
        return _patched(modes, plate, layout, every, (1.4 if wide else KEPT) * frequency_hz)._asdict()

    return LoadedModes(**remember("other", key, compute))


def _bare(plate: Plate, counts: tuple[int, int], below_hz: float) -> Modes:
    """Return the modes of the free plate; cached on disk, as many cases share it."""
    key = {"plate": plate.model_dump(), "material": material_of(plate), "counts": counts, "below_hz": below_hz}
    return Modes(**remember("bare", key, lambda: solve(plate, counts, below_hz)._asdict()))


def _patched(modes: Modes, plate: Plate, layout: Layout, patches: list[Patch], below_hz: float) -> LoadedModes:
    n, nx, ny = modes.w.shape
    mass, stiff = np.eye(n), np.diag(modes.omega_rad_s**2)
    nu = material_of(plate).nu
    for patch in patches:
        at = _Values(modes, plate, patch)
        for factor, rows in (
            (patch.mass_kg_m2, [at.w]),
            (patch.rotary_kg, [at.psi_x, at.psi_y]),
            (patch.bending_n_m * (1 + nu) / 2, [at.bend_x + at.bend_y]),
            (patch.bending_n_m * (1 - nu) / 2, [at.bend_x - at.bend_y, at.twist]),
            (patch.shear_n_m, [at.shear_x, at.shear_y]),
        ):
            if factor:
                total = mass if factor in (patch.mass_kg_m2, patch.rotary_kg) else stiff
                for row in rows:
                    total += factor * (row @ row.T)
    root = np.linalg.cholesky(mass)
    half = np.linalg.solve(root, stiff)
    squares, vectors = np.linalg.eigh(np.linalg.solve(root, half.T))
    omega = np.sqrt(np.maximum(squares, 0.0))
    omega[:3] = 0.0
    kept = omega < 2 * np.pi * below_hz
    V = np.linalg.solve(root.T, vectors[:, kept]).T
    w = modes.w.reshape(n, -1)
    rims = [legendre.rim_average(c * 1e-3, 0.45e-3 * layout.diameter_mm, size_m(plate), (nx, ny))
            for c in layout.centres_mm]  # fmt: skip
    discs = np.stack(
        [modes.psi_x.reshape(n, -1) @ x.ravel() + modes.psi_y.reshape(n, -1) @ y.ravel() for x, y in rims], axis=1
    )
    return LoadedModes(omega[kept], (V @ w).reshape(-1, nx, ny), V @ discs)


class _Values:
    """Fields of modes at a patch's points, times the root of each point's area; each (n, Q)."""

    def __init__(self, modes: Modes, plate: Plate, patch: Patch) -> None:
        x, y, area = _points(patch)
        size, counts = size_m(plate), modes.w.shape[1:]
        px, py = (legendre.values(at, side, count) for at, side, count in zip((x, y), size, counts, strict=True))
        dx, dy = (p @ legendre.derivative(side, count) for p, side, count in zip((px, py), size, counts, strict=True))
        root = np.sqrt(area)

        def at(field: Floats, along_x: Floats, along_y: Floats) -> Floats:
            return np.asarray(((field @ along_y.T).transpose(0, 2, 1) * along_x).sum(axis=2) * root)

        self.w, self.psi_x, self.psi_y = at(modes.w, px, py), at(modes.psi_x, px, py), at(modes.psi_y, px, py)
        self.bend_x, self.bend_y = at(modes.psi_x, dx, py), at(modes.psi_y, px, dy)
        self.twist = at(modes.psi_x, px, dy) + at(modes.psi_y, dx, py)
        self.shear_x = at(modes.w, dx, py) + self.psi_x
        self.shear_y = at(modes.w, px, dy) + self.psi_y


def _points(patch: Patch) -> tuple[Floats, Floats, Floats]:
    """Return points and areas of a patch, m and m^2."""
    half_x, half_y = patch.half_x_mm * 1e-3, patch.half_y_mm * 1e-3
    if patch.round:
        u, v, weight = legendre.disc_rule(3 + int(500 * half_x), 8 + int(1500 * half_x))
        area = np.pi * half_x * half_y * weight
    else:
        count = [4 + int(600 * half) for half in (half_x, half_y)]
        (a, wa), (b, wb) = (np.polynomial.legendre.leggauss(c) for c in count)
        u, v = (grid.ravel() for grid in np.meshgrid(a, b, indexing="ij"))
        area = half_x * half_y * np.outer(wa, wb).ravel()
        if patch.corner:
            area = area * (u + v < 0)
    return patch.x_mm * 1e-3 + half_x * u, patch.y_mm * 1e-3 + half_y * v, area
