"""What a plate carries, in a fit: its discs, and springs, dashpots and mass along lines near each held edge.

Discs load the plate, drive it and sense it by means over them. A tape, a row of pads or a jaw is a strip that answers
the deflection above it. Its load per area is counted in the plate's own inertia at the band's middle w0, rho h w0^2,
and follows a frequency w as

    (stiffness + i damping / 2) (1 + i loss) + (i damping / 2 - mass) (w / w0)^2

A dashpot's i w c is its tangent in w^2, as in `touchd.twin.physics.mounting`, so that the fitted plate has modes; its
stiffness has the plate's loss factor, as in those modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from touchd.calibration.loaded_plate import Load
from touchd.calibration.reduced_plate import Complex, Floats, ReducedPlate, Shape
from touchd.twin.physics import legendre
from touchd.twin.physics.material import ElasticPlate, stiffness_of
from touchd.twin.physics.mounting import Attachment, Support
from touchd.twin.physics.transducer import MEANS, scatterer_vectors, vectors_at

LEAST_RATIO = 0.05
"""Of frequency over the band's middle: below it the loss stays as it is."""
SIDES = ("left", "right", "top", "bottom")
KINDS = ("stiffness", "damping", "mass")
SCATTERER = ("x", "y", "radius", "mass", "stiffness")
WIDTH_MM = 6.0
"""A strip's width: it trades off against stiffness."""
FEWER = 5
"""Polynomials along an edge, less than the plate's: the others are beyond its waves."""
_LINE_MM = 0.2
"""Width of a line where the plate's modes take it for an area."""


class Discs(NamedTuple):
    """The discs of a plate: D of them, the emitter first."""

    centres_m: Floats
    """Shape (D, 2)."""
    radius_m: float
    mass_kg_m3: float
    """Mass of each over the plate's density, m^3."""
    stiffness_m3: Floats
    """Resistance of each to the rotation around its rim, over the plate's Young's modulus, m^3, shape (D,)."""
    gyration2_m2: float
    """Square of its radius of gyration about a line in the plate's middle, m^2: what rolls as the plate tilts."""
    beads_m: Floats
    """From each centre to the bead of solder and glue where its cable leaves, shape (D, 2)."""
    beads_kg_m3: Floats
    """Mass of each bead over the plate's density, m^3, shape (D,)."""
    scatterers: Floats = np.zeros((0, 5))
    """Of each of L scatterers x and y, m; radius, m; mass over the plate's density and stiffness over its Young's
    modulus, m^3: shape (L, 5)."""
    stretch_per_m: float = 0.0
    """How far the plate's middle moves them in the plane, over how far its rotations do."""

    @property
    def face_m2(self) -> float:
        """What of the square is in the face of a disc of evenly spread mass, m^2."""
        return self.radius_m**2 / 4

    @property
    def lever2_m2(self) -> float:
        """What is beyond the face: the square of the disc's height below the plate's middle, m^2."""
        return max(self.gyration2_m2 - self.face_m2, 0.0)

    @property
    def spread(self) -> float:
        """How far the mass is spread: 0 in the centre, 1 evenly."""
        return min(self.gyration2_m2 / self.face_m2, 1.0)


class Loss(NamedTuple):
    """Loss factor (f / f0)^slope times `factor`."""

    factor: float
    slope: float
    middle_rad_s: float

    def at(self, nu_rad_s: Complex) -> Floats:
        """Return the loss factor at angular frequencies."""
        return np.asarray(self.factor * np.maximum(nu_rad_s.real / self.middle_rad_s, LEAST_RATIO) ** self.slope)


def vectors_of(plate: ReducedPlate, shape: Shape, discs: Discs) -> Floats:
    """Return the discs and the scatterers in the reference's modes, (n, MEANS D + C L)."""
    return np.concatenate([disc_vectors(plate, shape, [discs])[0], cell_vectors(plate, shape, discs)], axis=1)


def disc_vectors(plate: ReducedPlate, shape: Shape, several: Sequence[Discs]) -> Floats:
    """Return each of k guesses of the discs in the reference's modes, mean by mean, shape (k, n, MEANS D)."""
    size, k, D = (shape.width, shape.height), len(several), len(several[0].centres_m)
    centres_m, beads_m = (np.concatenate([getattr(one, name) for one in several]) for name in ("centres_m", "beads_m"))
    radii_m = np.repeat([one.radius_m for one in several], D)
    found = vectors_at(centres_m, beads_m, radii_m, size, plate.counts, plate.sums).reshape(-1, MEANS, k, D)
    found[plate.in_plane] *= np.array([one.stretch_per_m for one in several])[:, None]
    return np.asarray(np.sqrt(size[0] * size[1]) * found.transpose(2, 0, 1, 3).reshape(k, -1, MEANS * D))


def cell_vectors(plate: ReducedPlate, shape: Shape, discs: Discs) -> Floats:
    """Return the scatterers in the reference's modes, each mean by mean over its cells, shape (n, C L)."""
    size = shape.width, shape.height
    found = [
        scatterer_vectors(np.array([x, y]), radius, size, shape.h, plate.counts, plate.sums, plate.in_plane)
        for x, y, radius, *_ in discs.scatterers
    ]
    return np.asarray(np.sqrt(size[0] * size[1]) * np.concatenate([np.zeros((len(plate.in_plane), 0)), *found], axis=1))


class Start(NamedTuple):
    """How a kind of edge is held, before the fit: values and standard deviations of `KINDS`."""

    values: tuple[float, float, float]
    priors: tuple[float, float, float]
    rows: int
    """Lines across the strip: two where it resists rotation, too."""


STARTS = {
    "pads": Start((0.01, 0.01, 0.0), (0.03, 0.03, 0.03), 1),
    "tape": Start((0.02, 0.04, 0.03), (0.1, 0.1, 0.1), 1),
    "clamped": Start((1.0, 0.05, 0.0), (1.0, 0.2, 0.2), 2),
}
STARTS_HZ = 75e3
"""The band's middle that they are for."""


def start_of(kind: str, middle_hz: float) -> Start:
    """Return how an edge is held in a band: what is as stiff is more of the plate's inertia at a lower frequency."""
    start, ratio = STARTS[kind], STARTS_HZ / middle_hz
    by_kind = ratio**2, ratio, 1.0  # of a stiffness, a dashpot, a mass
    values, priors = (tuple(np.multiply(each, by_kind).tolist()) for each in start[:2])
    return start._replace(values=values, priors=priors)


class Edges(NamedTuple):
    """The sides that are held, and how."""

    kinds: dict[str, str]
    """What holds each side that is not free, in the order of `SIDES`."""
    values: dict[str, float]
    """Values by name, for example `left damping`."""
    middle_rad_s: float

    def turned_back(self, orientation: int) -> Edges:
        """Return the edges of a plate whose drawing was mirrored left to right (bit 0) and top to bottom (bit 1).

        With bit 2 x and y were exchanged before that.
        """
        across = orientation >> 1 & 2
        other = {side: SIDES[k ^ (orientation >> k // 2 & 1) ^ across] for k, side in enumerate(SIDES)}
        values = {f"{other[name.split()[0]]} {name.split()[1]}": value for name, value in self.values.items()}
        return self._replace(kinds={other[side]: kind for side, kind in self.kinds.items()}, values=values)


class Guess(NamedTuple):
    """A vector of the unknowns, read as plate, discs, loss and edges."""

    shape: Shape
    discs: Discs
    loss: Loss
    edges: Edges


class Lines(NamedTuple):
    """The lines along held edges, in E vectors: the deflection along a line in Legendre's polynomials."""

    vectors: Floats
    """In the reference's modes, shape (n, E)."""
    weights: dict[str, Floats]
    """By side, each vector's share of the plate's area, shape (E,); 0 for other sides' vectors."""

    def loads(self, middle_rad_s: float, nu_rad_s: Complex, stiff: Complex) -> dict[str, Complex]:
        """Return each unknown's load per its unit and per mass of the plate, by name, shape (F, E).

        `stiff` (F,) is the factor 1 + i loss.
        """
        ratio2 = (nu_rad_s / middle_rad_s) ** 2
        laws = {"stiffness": stiff, "damping": 0.5j * (stiff + ratio2), "mass": -ratio2}
        return {
            f"{side} {kind}": middle_rad_s**2 * law[:, None] * weight
            for side, weight in self.weights.items()
            for kind, law in laws.items()
        }

    def added(self, load: Load, edges: Edges, by_name: dict[str, Complex]) -> Load:
        """Return a load with that of the edges; `by_name` is what `loads` returned."""
        unit, weights = edges.middle_rad_s**2, np.array(list(self.weights.values()))
        values = np.array([[max(edges.values[f"{side} {kind}"], 0.0) for side in self.weights] for kind in KINDS])
        springs, dashpots, masses = values
        damped = [each * by_name[f"{side} damping"] for side, each in zip(self.weights, dashpots, strict=True)]
        return Load(
            np.concatenate([load.springs, unit * (springs @ weights)]),
            np.concatenate([load.masses, masses @ weights]),
            np.sum(damped, axis=0),
        )

    def elastic(self, edges: Edges) -> Complex:
        """Return the load that the loss factor multiplies, without it, shape (1, E)."""
        found = np.zeros((1, self.vectors.shape[1]), complex)
        for side, weight in self.weights.items():
            stiffness, damping = (max(edges.values[f"{side} {kind}"], 0.0) for kind in KINDS[:2])
            found += edges.middle_rad_s**2 * (stiffness + 0.5j * damping) * weight
        return found


def lines_along(plate: ReducedPlate, kinds: dict[str, str]) -> Lines:
    """Return the lines along held edges of a plate of the reference's size."""
    size = plate.reference.width, plate.reference.height
    unit = np.sqrt(size[0] * size[1])
    vectors, owners, shares = list[Floats](), list[str](), dict[str, float]()
    for side, kind in kinds.items():
        axis, depths = SIDES.index(side) // 2, depths_mm(kind)
        count = plate.counts[1 - axis] - FEWER
        shares[side] = WIDTH_MM * 1e-3 / size[axis] / len(depths)
        owners += [side] * count * len(depths)
        for depth_mm in depths:
            at_m = 1e-3 * depth_mm if side in ("left", "top") else size[axis] - 1e-3 * depth_mm
            # The polynomials along the line are orthonormal over its length.
            across = legendre.values(at_m, size[axis], plate.counts[axis])
            line = np.zeros((count, *plate.counts))
            for k, one in enumerate(line):
                one.swapaxes(0, axis)[:, k] = across
            vectors.append(unit / np.sqrt(size[1 - axis]) * plate.sums(0, line))
    owner = np.array(owners)
    return Lines(np.concatenate(vectors, axis=1), {side: share * (owner == side) for side, share in shares.items()})


def depths_mm(kind: str) -> list[float]:
    """Return the depths of a strip's lines, those of Gauss' rule."""
    node = np.polynomial.legendre.leggauss(STARTS[kind].rows)[0]
    return [float(depth_mm) for depth_mm in WIDTH_MM * (node + 1) / 2]


def attachments(edges: Edges, plate: ElasticPlate) -> tuple[Attachment, ...]:
    """Return held edges as the twin attaches them to a plate."""
    unit = stiffness_of(plate).mass * edges.middle_rad_s**2
    sizes, found = plate.size_mm, []
    for side, kind in edges.kinds.items():
        axis, rows = SIDES.index(side) // 2, STARTS[kind].rows
        stiffness, damping, mass = (
            max(edges.values[f"{side} {each}"], 0.0) * unit * WIDTH_MM / rows / _LINE_MM for each in KINDS
        )
        support = Support(
            stiffness_n_m3=stiffness, dashpot_n_s_m3=damping / edges.middle_rad_s,
            mass_kg_m2=mass / edges.middle_rad_s**2,
        )  # fmt: skip
        for depth_mm in depths_mm(kind):
            middle = depth_mm if side in ("left", "top") else sizes[axis] - depth_mm
            across, along = (middle - _LINE_MM / 2, middle + _LINE_MM / 2), (0.0, sizes[1 - axis])
            x, y = (along, across) if axis else (across, along)
            found.append(Attachment(x_mm=x, y_mm=y, support=support))
    return tuple(found)
