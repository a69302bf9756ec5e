"""Piezoceramic discs under the plate: positions, averages over the discs, and their mass in the plate's modes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.cache import remember
from touchd.twin.physics import in_plane, legendre
from touchd.twin.physics.material import material_of
from touchd.twin.physics.plate import MANY_POLYNOMIALS, Modes, polynomials_for, size_m, solve

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

VERSION = 3
"""Version of the algorithm; increase it when the same rig gives other modes, to invalidate files on disk."""

OTHER_BENDING = 0.54
"""A disc's resistance to the other two rotations around its rim over that to the outward one: (1 - nu) / (1 + nu) for
PZT's nu of 0.3."""
MEANS = 9
"""Means over a disc, by which it drives and loads the plate. Without the moments a fit left 3.7 % of the untouched
energy on acrylic, where the disc is three quarters of a wavelength and twice as heavy as the plate under it; with them
1.4."""
BEAD_M = 1e-3
"""Radius of a bead."""
CELLS = 7
"""Parts of a scatterer."""
CELL_STIFFNESS = np.array([1, OTHER_BENDING, OTHER_BENDING, 0, 0, 0, 1, OTHER_BENDING, OTHER_BENDING, 0, 0])
CELL_MASS = np.array([0, 0, 0, 1, 1, 1, 0, 0, 0, 1, 1]) / CELLS
"""Shares of a scatterer's stiffness and mass that each mean over a cell counts with."""
LEAST_MASS = 0.05
"""Share of the plate's mass that a hole leaves of any motion at least."""
RIGID_RAD_S = 2 * np.pi
"""Slower modes are rigid motions, to which rounding has given a frequency."""
BASIS_HZ = 3.0
"""Modes of the bare plate up to this many times the highest frequency carry the discs' masses."""
KEPT_HZ = 2.0
"""Modes of the loaded plate up to this many times the highest frequency are kept."""
BASIS_OF_MANY_HZ, KEPT_OF_MANY_HZ = 1.6, 1.3
"""The same for a plate that needs more than `MANY_POLYNOMIALS`: it has thousands of modes more, and hears less of
them, as it is soft and lossy."""


class Scatterer(BaseModel):
    """What is glued on the plate or cut out of it: a button, a hole. Waves are scattered by its mass and stiffness."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    at_mm: tuple[float, float]
    diameter_mm: float = Field(gt=0)
    mass_g: float = 0.0
    """Negative where something is cut out, as is the stiffness."""
    stiffness_n_m: float = 0.0
    """Resistance to the mean rotation around the rim of a part of it, N m per rad: the same for parts of any size."""


class Layout(BaseModel):
    """Centres and size of the discs, and what else the plate carries."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    emitter_mm: tuple[float, float]
    receivers_mm: tuple[tuple[float, float], ...] = Field(min_length=1)
    diameter_mm: float = Field(default=6.0, gt=0)
    mass_g: float = Field(default=0.43, ge=0)
    """Mass of each disc: 6 mm by 2 mm of PZT."""
    stiffnesses_n_m: tuple[float, ...] = ()
    """Resistance of each disc to the mean rotation around its rim, N m per rad, emitter first; empty for none."""
    lever_mm: float = Field(default=0.0, ge=0)
    """Height of each disc's middle below the plate's: the plate's rotations move it in the plane."""
    spread: float = Field(default=0.0, ge=0, le=1)
    """How far each disc's mass is spread: 0 in its centre, 1 evenly, so that it moves with the deflection's slopes."""
    beads_mm: tuple[tuple[float, float], ...] = ()
    """From each disc's centre, emitter first, to the bead of solder and glue where its cable leaves; empty for none."""
    beads_g: tuple[float, ...] = ()
    """Masses of the beads."""
    scatterers: tuple[Scatterer, ...] = ()
    stretch_per_mm: float = Field(default=0.0, ge=0)
    """How far the plate's middle moves a disc in the plane, over how far the plate's rotations do: one over the disc's
    height above it. 0 for discs that feel rotations alone."""

    @property
    def centres_mm(self) -> Floats:
        """Centres of emitter and receivers, shape (1 + receivers, 2)."""
        return np.array([self.emitter_mm, *self.receivers_mm])


def default_layout(plate: Plate) -> Layout:
    """Place an emitter and four receivers without any symmetry.

    A symmetric layout cannot distinguish mirrored touches on a symmetric plate. Positions for 200 x 200 mm are scaled
    to the plate's size.
    """
    sx, sy = plate.width_mm / 200, plate.height_mm / 200
    receivers = ((15.0, 15.0), (185.0, 20.0), (180.0, 185.0), (20.0, 170.0))
    return Layout(emitter_mm=(30 * sx, 100 * sy), receivers_mm=tuple((x * sx, y * sy) for x, y in receivers))


class LoadedModes(NamedTuple):
    """Modes of the plate with its discs, and their values at the discs: n modes, unit modal mass.

    They are real, or complex with attachments (`touchd.twin.physics.mounting`).
    """

    omega_rad_s: Floats | Complex
    """Angular frequencies, shape (n,)."""
    w: Floats | Complex
    """Deflection in Legendre products, shape (n, nx, ny)."""
    discs: Floats | Complex
    """Mean outward rotation around the rim of each disc, shape (n, 1 + receivers); column 0 is the emitter."""


def loaded_modes(plate: Plate, layout: Layout, frequency_hz: float = 125e3) -> LoadedModes:
    """Return the modes of a plate with discs, for use up to a frequency; cached on disk.

    Raises SimulationError if a disc reaches over the edge, the plate is too large, or its material is unknown.
    """
    width, height = plate.width_mm, plate.height_mm
    edge = np.minimum(layout.centres_mm, np.array([width, height]) - layout.centres_mm).min()
    if edge < layout.diameter_mm / 2:
        raise SimulationError(
            f"a transducer reaches over the edge of the {width:g} x {height:g} mm plate",
            "layout",
            f"keep centres {layout.diameter_mm / 2:g} mm from the edge",
        )
    parameters = parameters_of(plate, layout, frequency_hz)

    def compute() -> dict[str, Floats]:
        modes = solve(plate, parameters["counts"], parameters["basis"] * frequency_hz)
        if layout.stretch_per_mm:
            below_hz = parameters["kept"] * frequency_hz
            others = in_plane.solve(plate, 0.8 * frequency_hz, parameters["counts"], below_hz)
            modes = Modes(*map(np.concatenate, zip(modes, others, strict=True)))
        return load(modes, plate, layout, parameters["kept"] * frequency_hz)._asdict()

    return LoadedModes(**remember("plate", parameters, compute))


def parameters_of(plate: Plate, layout: Layout, frequency_hz: float) -> dict[str, Any]:
    """Return all that the modes of a plate with discs depend on, as JSON types."""
    # Converged at four fifths of the highest frequency, where the emission ends (100 of 125 kHz).
    counts = polynomials_for(plate, 0.8 * frequency_hz)
    many = max(counts) > MANY_POLYNOMIALS
    return {
        "version": VERSION,
        "plate": plate.model_dump(),
        "material": material_of(plate),
        "layout": layout.model_dump(),
        "frequency_hz": frequency_hz,
        "counts": counts,
        "basis": BASIS_OF_MANY_HZ if many else BASIS_HZ,
        "kept": KEPT_OF_MANY_HZ if many else KEPT_HZ,
    }


def load(modes: Modes, plate: Plate, layout: Layout, below_hz: float = np.inf) -> LoadedModes:
    """Add the discs' masses and stiffnesses to a bare plate's modes.

    In modal coordinates each mass is a rank-one change of the unit mass matrix. The loaded plate's modes are exact
    within the given ones, and no later computation needs the update.
    """
    n, *counts = modes.w.shape
    fields = [field.reshape(n, -1) for field in modes[1:]]

    def sums(field: int, weights: Floats) -> Floats:
        return np.asarray(fields[field] @ weights.reshape(len(weights), -1).T)

    undeflected = np.logical_not(fields[0].any(axis=1))
    vectors = vectors_of(layout, plate, (counts[0], counts[1]), sums, undeflected)
    omega, V = with_discs(modes.omega_rad_s, vectors, layout, below_hz)
    discs = vectors[:, : len(layout.centres_mm)]
    return LoadedModes(omega, (V @ fields[0]).reshape(len(V), *counts), V @ discs)


Sums = Callable[[int, Floats], Floats]
"""Returns sums of n modes' coefficients, of w, psi_x or psi_y by number, times weights (k, nx, ny), shape (n, k)."""


def vectors_of(
    layout: Layout, plate: Plate, counts: tuple[int, int], sums: Sums, in_plane: NDArray[np.bool_]
) -> Floats:
    """Return the means over a layout's discs, as `vectors_at` does, and over its scatterers.

    `in_plane` (n,) are the modes without a deflection.
    """
    beads_m = np.array(layout.beads_mm or 0.0) * 1e-3
    size, thickness_m = size_m(plate), plate.thickness_mm * 1e-3
    discs = vectors_at(layout.centres_mm * 1e-3, beads_m, layout.diameter_mm / 2e3, size, counts, sums)
    discs[in_plane] *= 1e3 * layout.stretch_per_mm
    others = [
        scatterer_vectors(
            1e-3 * np.array(each.at_mm), each.diameter_mm / 2e3, size, thickness_m, counts, sums, in_plane
        )
        for each in layout.scatterers
    ]
    return np.concatenate([discs, *others], axis=1)


def scatterer_vectors(
    centre_m: Floats, radius_m: float, size_m: tuple[float, float], thickness_m: float, counts: tuple[int, int],
    sums: Sums, in_plane: NDArray[np.bool_],
) -> Floats:  # fmt: skip
    """Return the means over the cells of a scatterer, shape (n, len(CELL_MASS) CELLS), mean by mean.

    Of bending modes they are the three rotations around the cell's rim, the deflection, and its moments; of modes in
    the plane the three displacements around the rim, counted so that what resists a bending resists them as a plate
    does, and the mean ones. A hole goes through the plate, and turns no wave of one kind into one of the other. A
    scatterer is moved inwards where it would reach over the edge.
    """
    size, radius_m = np.array(size_m), min(radius_m, 0.45 * min(size_m))
    centre_m = np.clip(centre_m, 1.1 * radius_m, size - 1.1 * radius_m)
    around = 2 * np.pi * np.arange(CELLS - 1) / (CELLS - 1)
    # One in the middle, the others about it, so that they have the disc's area and second moment.
    ring = np.sqrt(0.5) * np.stack([np.cos(around), np.sin(around)], axis=1)
    cells_m = centre_m + radius_m * np.concatenate([np.zeros((1, 2)), ring])
    means = vectors_at(cells_m, np.zeros(2), radius_m / np.sqrt(CELLS), size_m, counts, sums)
    by_mean = means.reshape(len(means), MEANS, CELLS)
    found = by_mean[:, [0, 1, 2, 3, 6, 7, 0, 1, 2, 4, 5]]
    found[in_plane, :6], found[~in_plane, 6:] = 0.0, 0.0
    found[:, 6:9] *= np.sqrt(12) / thickness_m
    return found.reshape(len(means), -1)


def vectors_at(
    centres_m: Floats, beads_m: Floats, radius_m: float | Floats, size_m: tuple[float, float],
    counts: tuple[int, int], sums: Sums,
) -> Floats:  # fmt: skip
    """Return means of modes over D discs by which they drive and load the plate, shape (n, MEANS D), mean by mean.

    The discs' radii are of shape (D,), or one for all.

    The outward rotation around the rim, and the two others there; under the disc the deflection, the two rotations, and
    the deflection's two moments; and the deflection under a bead `beads_m` from its centre, at most on the edge.
    """
    radii = np.broadcast_to(np.asarray(radius_m), len(centres_m))
    rims = legendre.rim_average(centres_m, radii, size_m, counts)
    under = legendre.disc_average(centres_m, radii, size_m, counts)
    moments = legendre.disc_moments(centres_m, radii, size_m, counts)
    places_m = np.clip(centres_m + beads_m, BEAD_M, np.array(size_m) - BEAD_M)
    beads = legendre.disc_average(places_m, np.full(len(centres_m), BEAD_M), size_m, counts)
    # One product for all means of a field: the modes' coefficients are much more than the discs' weights.
    (w, *others), (xx, xy, mean_x), (yx, yy, mean_y) = (
        np.split(sums(field, np.concatenate(weights)), len(weights), axis=1)
        for field, weights in enumerate(((under, *moments, beads), (*rims, under), (*rims, under)))
    )
    return np.concatenate([xx + yy, xx - yy, xy + yx, w, mean_x, mean_y, *others], axis=1)


def with_discs(omega_rad_s: Floats, vectors: Floats, layout: Layout, below_hz: float = np.inf) -> tuple[Floats, Floats]:
    """Return angular frequencies (k,) of a plate with discs, and its modes (k, n) in the bare plate's n.

    `vectors` are those of `vectors_at`.
    """
    discs, others = np.split(vectors, [len(layout.centres_mm) * MEANS], axis=1)
    cells = others.reshape(len(others), len(layout.scatterers), len(CELL_MASS) * CELLS).transpose(1, 0, 2)
    springs, weights = (np.repeat(each, CELLS) for each in (CELL_STIFFNESS, CELL_MASS))
    outward, other_1, other_2, mean, *rolls, slope_x, slope_y, bead = np.split(discs, MEANS, axis=1)
    lever, tilt = layout.lever_mm * 1e-3, np.sqrt(layout.spread)
    moved = [mean, *(lever * roll for roll in rolls if lever), *(tilt * slope for slope in (slope_x, slope_y) if tilt)]
    heavy = [(np.concatenate(moved, axis=1), layout.mass_g)]
    heavy += [(bead[:, [k]], mass_g) for k, mass_g in enumerate(layout.beads_g)]
    scatterers = list(zip(cells, layout.scatterers, strict=True))
    heavy += [((own * np.sqrt(weights))[:, weights > 0], each.mass_g) for own, each in scatterers]
    bending = np.sqrt([1.0, OTHER_BENDING, OTHER_BENDING])
    rims = np.stack([outward, other_1, other_2], axis=2) * bending  # (n, D, 3)
    stiff = [(rims[:, k], each) for k, each in enumerate(layout.stiffnesses_n_m)]
    stiff += [((own * np.sqrt(springs))[:, springs > 0], each.stiffness_n_m) for own, each in scatterers]
    B, masses = _weighed([(part, 1e-3 * mass_g) for part, mass_g in heavy])
    # M = 1 + B m B'; its inverse root differs from 1 only in the span of B.
    Q, R = np.linalg.qr(B)
    changes, W = np.linalg.eigh((R * masses) @ R.T)
    U = Q @ W
    root = (U * (np.maximum(1 + changes, LEAST_MASS) ** -0.5 - 1)) @ U.T
    root[np.diag_indices(len(root))] += 1
    stiffness = (root * omega_rad_s**2) @ root
    if stiff:
        bent, springs = _weighed(stiff)
        stiffened = root @ bent
        stiffness += (stiffened * springs) @ stiffened.T
    squared, V = np.linalg.eigh(stiffness)
    omega = np.sqrt(np.maximum(squared, 0.0))
    omega[omega < RIGID_RAD_S] = 0.0
    V = (root @ V[:, omega < 2 * np.pi * below_hz]).T
    return omega[: len(V)], V


def _weighed(parts: list[tuple[Floats, float]]) -> tuple[Floats, Floats]:
    """Join vectors, each (n, k) with one weight: (n, m) and (m,)."""
    return (
        np.concatenate([part for part, _ in parts], axis=1),
        np.concatenate([np.full(part.shape[1], weight) for part, weight in parts]),
    )
