"""Plates by other physics than a fit has: discs with rotary inertia and stiffness in all directions, ribs, holes.

Everything is a patch that adds to the plate's energies, integrated over points: mass and rotary inertia per area, and
bending and shear stiffness. A negative patch takes the plate away. The fields are sums of the bare plate's modes and of
functions around each disc, which bend as sharply as the plate does there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Plate
from touchd.lab.plates.disc_functions import COUNT, DiscFunctions
from touchd.twin.cache import remember
from touchd.twin.physics import in_plane, legendre
from touchd.twin.physics.corners import inside
from touchd.twin.physics.material import corner_radius_m, material_of, stiffness_of
from touchd.twin.physics.plate import Modes, polynomials_for, size_m, solve
from touchd.twin.physics.transducer import Layout, LoadedModes

Floats = NDArray[np.float64]

VERSION = 5
BASIS, BASIS_OF_MANY = 2.2, 1.6
"""Times the band's end: modes that carry the patches; fewer where a plate has thousands, which leave 1e-3 of the
untouched energy. All modes of the loaded plate are kept: the highest stand for how the plate gives way at a disc."""
IN_PLANE, IN_PLANE_OF_MANY = 1.8, 1.3
"""The same of the modes in the plate's plane."""
LEVER_M = 3.5e-3
"""Height of a disc's middle over the plate's: it bends, rolls, stretches, drives and senses there."""
REACH = 2.5
"""Radii of a disc to which the functions around it reach; less where an edge or another disc is near."""
LEAST_NEW = 1e-9
"""A function with less than this share that no others make up adds nothing but rounding errors."""


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
    stretch_n_m: float = 0.0
    """Stiffness in the plane of what lies in the plate's middle."""
    lever_m: float = 0.0
    """Height over the plate's middle of what bends, rolls and stretches as one; 0 for what lies in the middle."""
    round: bool = True
    corner: bool = False
    """Whether it is the triangle towards the rectangle's corner of least x and y."""
    orthotropy: float = 1.0
    shear_ratio: float = 1.0
    """Of the bending stiffness, as `Material` has them."""


def disc_patches(layout: Layout) -> list[Patch]:
    """Return the discs as 2 mm of PZT (7600 kg/m^3, 62 GPa); the bond takes half of their stiffness."""
    radius, density, young, thick = layout.diameter_mm / 2, 7600.0, 62e9, 2e-3
    return [
        Patch(
            float(x), float(y), radius, radius, density * thick, density * thick * LEVER_M**2,
            0.5 * young * thick * LEVER_M**2 / (1 - 0.3**2), lever_m=LEVER_M,
        )
        for x, y in layout.centres_mm
    ]  # fmt: skip


def missing(plate: Plate, share: float, **where: float | bool) -> Patch:
    """Return a patch that takes a share of the plate away."""
    s = stiffness_of(plate)
    return Patch(
        mass_kg_m2=-share * s.mass, rotary_kg=-share * s.rotary, bending_n_m=-share * s.bending,
        shear_n_m=-share * s.shear, stretch_n_m=-share * 12 * s.bending / (plate.thickness_mm * 1e-3) ** 2, **where,  # type: ignore[arg-type]  # the rest are places
    )  # fmt: skip


def other_modes(plate: Plate, layout: Layout, patches: list[Patch], frequency_hz: float = 100e3) -> LoadedModes:
    """Return the modes of a plate with its discs and other patches; cached on disk."""
    counts = polynomials_for(plate, frequency_hz)
    key = {
        "version": VERSION, "plate": plate.model_dump(), "material": material_of(plate), "counts": counts,
        "layout": layout.model_dump(), "patches": patches, "frequency_hz": frequency_hz,
    }  # fmt: skip

    def compute() -> dict[str, Floats]:
        basis, plane = (BASIS_OF_MANY, IN_PLANE_OF_MANY) if max(counts) > 80 else (BASIS, IN_PLANE)
        modes = _bare(plate, counts, basis * frequency_hz)
        beside = in_plane.solve(plate, frequency_hz, counts, plane * frequency_hz)
        return _patched(modes, beside, plate, layout, patches)._asdict()

    return LoadedModes(**remember("other", key, compute))


def _bare(plate: Plate, counts: tuple[int, int], below_hz: float) -> Modes:
    """Return the modes of the free plate; cached on disk, as many cases share it."""
    key = {"plate": plate.model_dump(), "material": material_of(plate), "counts": counts, "below_hz": below_hz}
    return Modes(**remember("bare", key, lambda: solve(plate, counts, below_hz)._asdict()))


def _patched(bending: Modes, beside: Modes, plate: Plate, layout: Layout, patches: list[Patch]) -> LoadedModes:
    modes = Modes(*map(np.concatenate, zip(bending, beside, strict=True)))
    n, bent = len(modes.omega_rad_s), len(bending.omega_rad_s)
    basis = _Basis(modes, plate, _around(layout, plate))
    add = _Sum(basis.count, slice(bent, n), material_of(plate).nu)
    s = stiffness_of(plate)
    m = material_of(plate)
    whole = Patch(
        0.0, 0.0, 0.0, 0.0, s.mass, s.rotary, s.bending, s.shear, orthotropy=m.orthotropy, shear_ratio=m.shear_ratio
    )
    for k, disc in enumerate(basis.discs):
        add(basis.at(*disc.rule(), k), whole)
    mass, stiff = add.mass, add.stiff
    # Of the modes themselves the whole plate's energies are known; the above gave a disc's surroundings' only.
    mass[:n, :n], stiff[:n, :n] = np.eye(n), np.diag(modes.omega_rad_s**2)
    for patch in [*disc_patches(layout), *patches]:
        add(basis.at(*_points(patch)), patch)
    root = _inverse_root(mass)
    squares, vectors = np.linalg.eigh(root.T @ stiff @ root)
    omega = np.sqrt(np.maximum(squares, 0.0))
    omega[:6] = 0.0  # the rigid motions
    V = (root @ vectors).T
    turned = np.stack([basis.outward(c * 1e-3, 0.45e-3 * layout.diameter_mm) for c in layout.centres_mm], axis=1)
    turned[bent:n] /= LEVER_M
    return LoadedModes(omega, basis.deflection(V), V @ turned)


def _around(layout: Layout, plate: Plate) -> list[DiscFunctions]:
    """Return the functions around each disc, that overlap neither an edge nor each other."""
    centres, radius, found = layout.centres_mm * 1e-3, layout.diameter_mm * 0.5e-3, []
    _, edges = inside(centres, np.array(size_m(plate)), corner_radius_m(plate))
    for k, centre in enumerate(centres):
        others = np.linalg.norm(np.delete(centres, k, axis=0) - centre, axis=1) / 2
        reach = min(REACH * radius, edges[k], *others)
        found.append(DiscFunctions(centre[0], centre[1], radius, max(float(reach), 1.01 * radius)))
    return found


def _inverse_root(mass: Floats) -> Floats:
    """Return vectors of unit mass, less those that others nearly make up."""
    scale = np.sqrt(np.diag(mass))
    values, vectors = np.linalg.eigh(mass / np.outer(scale, scale))
    some = values > LEAST_NEW
    return np.asarray(vectors[:, some] / np.sqrt(values[some]) / scale[:, None])


class _Sum:
    """Sums the energies of patches: matrices of mass and stiffness between a basis' functions.

    Modes `in_plane` hold displacements in the place of rotations.
    """

    def __init__(self, count: int, in_plane: slice, nu: float) -> None:
        self.mass, self.stiff = np.zeros((2, count, count))
        self._in_plane, self._nu = in_plane, nu

    def __call__(self, at: tuple[NDArray[np.intp], Floats], patch: Patch) -> None:
        """Add a patch's energies; `at` is `_Basis.at` of its points."""
        rows, fields = at
        which, nu, ours = np.ix_(rows, rows), self._nu, self._in_plane
        # To a patch at a height a displacement in the plane is a rotation.
        plane, turned = np.zeros_like(fields[1:]), fields[1:].copy()
        plane[:, :, ours] = fields[1:, :, ours]
        turned[:, :, ours] *= 1 / patch.lever_m if patch.lever_m else 0.0
        w, (psi_x, psi_y), (u, v) = fields[0], turned, plane
        along = patch.orthotropy**0.25
        x_x, y_y = along * psi_x[1], psi_y[2] / along
        own, across = (0.0, 0.0) if patch.lever_m else (patch.mass_kg_m2, patch.rotary_kg * (nu / (1 - nu)) ** 2)
        bending = patch.bending_n_m / 2
        masses = (
            (patch.mass_kg_m2, [w[0]]),
            (patch.rotary_kg, [psi_x[0], psi_y[0]]),
            (own, [u[0], v[0]]),
            (across, [u[1] + v[2]]),
        )
        springs = (
            (bending * (1 + nu), [x_x + y_y]),
            (bending * (1 - nu), [x_x - y_y]),
            (bending * (1 - nu) * patch.shear_ratio, [psi_x[2] + psi_y[1]]),
            (patch.stretch_n_m * (1 + nu) / 2, [u[1] + v[2]]),
            (patch.stretch_n_m * (1 - nu) / 2, [u[1] - v[2], u[2] + v[1]]),
            (patch.shear_n_m, [w[1] + psi_x[0], w[2] + psi_y[0]]),
        )
        for total, terms in ((self.mass, masses), (self.stiff, springs)):
            for sign in (1, -1):
                alike = [(factor, parts) for factor, parts in terms if sign * factor > 0]
                if alike:  # all parts side by side: one product instead of up to eight
                    side = np.concatenate(
                        [np.sqrt(abs(factor)) * part for factor, parts in alike for part in parts], axis=1
                    )
                    total[which] += sign * (side @ side.T)


class _Basis:
    """A bare plate's modes, then the functions around each disc, each as deflection and as both rotations."""

    def __init__(self, modes: Modes, plate: Plate, discs: list[DiscFunctions]) -> None:
        self._modes, self._size = modes, size_m(plate)
        self.discs = discs
        n = len(modes.omega_rad_s)
        each = 3 * COUNT
        self._rows = [np.arange(n + each * k, n + each * (k + 1)) for k in range(len(discs))]
        self.count = n + each * len(discs)

    def at(self, x_m: Floats, y_m: Floats, area_m2: Floats, disc: int | None = None) -> tuple[NDArray[np.intp], Floats]:
        """Return the fields of n functions at points (Q,): of the modes, and of those around one disc or all.

        In order: the functions' numbers, (n,); and deflection and both rotations, each as value and slopes along x and
        y, times the root of each point's area, shape (3, 3, n, Q).
        """
        modes, some = self._modes, range(len(self.discs)) if disc is None else [disc]
        counts = modes.w.shape[1:]
        px, py = (legendre.values(at, side, n) for at, side, n in zip((x_m, y_m), self._size, counts, strict=True))
        dx, dy = (p @ legendre.derivative(side, n) for p, side, n in zip((px, py), self._size, counts, strict=True))

        # Value and both slopes of each product of polynomials, at all points: (nx ny, 3 Q).
        pairs = (px, py), (dx, py), (px, dy)
        products = [(along[:, :, None] * across[:, None]).reshape(len(x_m), -1) for along, across in pairs]
        table = np.concatenate(products).T
        fields = [(field.reshape(len(field), -1) @ table).reshape(len(field), 3, -1) for field in modes[1:]]
        parts = [np.stack(fields).transpose(0, 2, 1, 3)]
        for k in some:
            around = np.zeros((3, 3, 3, COUNT, len(x_m)))
            for kind in range(3):  # each function is one of the three fields
                around[kind, :, kind] = self.discs[k].at(x_m, y_m)
            parts.append(around.reshape(3, 3, -1, len(x_m)))
        rows = np.concatenate([np.arange(len(modes.omega_rad_s)), *(self._rows[k] for k in some)])
        return rows, np.concatenate(parts, axis=2) * np.sqrt(area_m2)

    def outward(self, centre_m: Floats, radius_m: float) -> Floats:
        """Return each function's mean outward rotation around a circle, shape (n,)."""
        angle = 2 * np.pi * np.arange(32) / 32
        normal = np.cos(angle), np.sin(angle)
        _, (_, psi_x, psi_y) = self.at(
            centre_m[0] + radius_m * normal[0], centre_m[1] + radius_m * normal[1], np.ones(32)
        )
        return np.asarray((psi_x[0] * normal[0] + psi_y[0] * normal[1]).mean(axis=1))

    def deflection(self, V: Floats) -> Floats:
        """Return the deflection of modes (m, n) in Legendre products, shape (m, nx, ny)."""
        n, nx, ny = self._modes.w.shape
        w = V[:, :n] @ self._modes.w.reshape(n, -1)
        for disc, rows in zip(self.discs, self._rows, strict=True):
            x, y, area = disc.rule()
            px, py = (legendre.values(at, side, k) for at, side, k in zip((x, y), self._size, (nx, ny), strict=True))
            value = disc.at(x, y)[0] * area
            products = np.stack([(px * row[:, None]).T @ py for row in value])
            w += V[:, rows[: len(value)]] @ products.reshape(len(value), -1)
        return np.asarray(w.reshape(-1, nx, ny))


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
