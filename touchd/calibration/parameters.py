"""The unknowns of a plate fit: names, units, what was said, and how surely a person knows it."""

from __future__ import annotations

from itertools import cycle, pairwise, starmap
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.loads import KINDS, SCATTERER, Discs, Edges, Guess, Loss, start_of
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.reduced_plate import Floats, Shape, shape_of
from touchd.frame import Acquisition, Chirp, Plate
from touchd.twin.physics.material import MATERIALS, ElasticPlate, Material, material_of, mindlin_wavenumber
from touchd.twin.physics.transducer import Layout, Scatterer

STIFFNESS_M3 = 1e-7
"""Unit of a disc's bending stiffness over the plate's Young's modulus: 6 mm of 2 mm PZT bonded to 5 mm glass have 2, of
which the bond takes half."""
DISC_THICKNESS_MM = 2.0
"""A disc's middle lies half of its and half of the plate's thickness below the plate's."""
LOSSES = {"aluminium": 2e-3, "steel": 2e-3}
"""Typical loss factors of mounted plates with bonded discs; of others `LOSS`, of plastics `PLASTIC_LOSS`."""
LOSS, PLASTIC_LOSS = 5e-3, 0.03
PLASTIC_M_S = 2500.0
"""Root of Young's modulus over density under which a plate is of plastic; glass and metals have twice as much."""
SPEED_PRIOR, POISSON_PRIOR = 0.02, 0.02
"""Standard deviations of handbook values: of the logarithm of the wave speed, and of Poisson's ratio."""
LOSS_PRIOR, SLOPE_PRIOR, MASS_PRIOR, SIZE_PRIOR, STIFFNESS_PRIOR, GYRATION_PRIOR = 0.7, 0.5, 0.3, 0.05, 1.5, 1.0
STRETCH_PRIOR = 0.5
"""Relative, of how far the plate's middle moves a disc in the plane over how far the plate's rotations do."""
PLANE_PRIOR, LEAST_PLANE = 0.05, 0.1
"""Of stiffness over mass in the plane: a display of 0.7 mm bonded on 5 mm of glass takes 12 % of it across alone."""
LEAST_CORNER_MM = 0.5
"""Radius of rounded corners, at least: of sharp ones there is no basis of plates with others."""
ROLLED_PRIOR = 0.05
"""Of how stiff a sheet is along the width over along the height, and of how stiff in shear: rolling leaves 10 %."""
ROLLED_RANGE = 0.5, 2.0
"""Where they are read."""
BOND_PRIOR = 0.3
"""Of how much stiffer one disc's bond is than another's, in the unit of stiffness."""
BEAD_G, BEAD_G_PRIOR, BEAD_MM_PRIOR = 0.05, 0.03, 4.0
"""Mass of a bead of solder and glue, its deviation, and that of its place along x and y from a disc's centre."""

SCATTERER_UNITS, SCATTERER_PRIORS = ("mm", "mm", "mm", "g", "1e-7 m^3"), (3.0, 1.0)
"""A hole of 16 mm in 5 mm of glass takes 2.5 g and 0.9e-7 m^3 away."""
RADIUS_PRIOR, LEAST_RADIUS_MM = 0.5, 0.5
"""Relative, and the least."""

FIRST = ("speed", "thickness", "loss")
PLATE = ("speed", "thickness", "loss", "poisson", "width", "height", "slope")
ROLLED = ("orthotropy", "shear_ratio")
DISCS = ("mass", "radius", "stiffness", "gyration", "stretch", "plane")
LOGARITHMS = frozenset({"speed", "thickness", "loss", "mass", "radius"})


class Unknown(NamedTuple):
    """One number of the fit's vector."""

    name: str
    label: str
    unit: str
    start: float
    prior: float
    """Standard deviation of what was said, in the vector's unit."""


def wavelength_mm(plate: Plate, chirp: Chirp) -> float:
    """Return the length of the plate's wave in the middle of a chirp's band."""
    return 2e3 * np.pi / float(mindlin_wavenumber(plate, np.mean(chirp.band_hz)))


def is_plastic(said: PlateFile) -> bool:
    """Return whether a plate's waves are as slow as those of plastics."""
    m = said.plate.elastic
    return bool(np.sqrt(m.E_pa / m.rho_kg_m3) < PLASTIC_M_S)


def usual_loss(said: PlateFile) -> float:
    """Return the loss factor that a plate of this material has as a rule."""
    other = PLASTIC_LOSS if is_plastic(said) else LOSS
    return LOSSES.get((said.plate.material or "").lower(), other)


def unknowns_of(said: PlateFile, chirp: Chirp) -> tuple[Unknown, ...]:
    """Return the fit's unknowns for a plate: logarithms of positive numbers, lengths in mm."""
    p, d, lever_mm, stiff = said.plate, said.discs, lever_mm_of(said), disc_stiffness_of(said)
    found = [
        Unknown("speed", "wave speed", "m/s", 0.0, SPEED_PRIOR),
        Unknown("thickness", "thickness", "mm", 0.0, p.thickness_uncertainty_mm / p.thickness_mm),
        Unknown("loss", "loss factor", "", np.log(usual_loss(said)), LOSS_PRIOR),
        Unknown("poisson", "Poisson's ratio", "", p.elastic.nu, POISSON_PRIOR),
        Unknown("width", "width", "mm", p.width_mm, p.width_uncertainty_mm),
        Unknown("height", "height", "mm", p.height_mm, p.height_uncertainty_mm),
        Unknown("slope", "slope of the loss", "", 0.0, SLOPE_PRIOR),
        Unknown("mass", "disc mass", "g", 0.0, MASS_PRIOR),
        Unknown("radius", "disc diameter", "mm", 0.0, SIZE_PRIOR),
        Unknown("stiffness", "disc stiffness", "1e-7 m^3", stiff, STIFFNESS_PRIOR * stiff),
        Unknown("gyration", "disc gyration, squared", "mm^2", 1.0, GYRATION_PRIOR),
        Unknown("stretch", "disc stretch", "1/mm", 1 / lever_mm, STRETCH_PRIOR / lever_mm),
        Unknown("plane", "in-plane stiffness", "", 1.0, PLANE_PRIOR),
    ]
    if p.rolled:
        found += [
            Unknown("orthotropy", "stiffness along the width over that along the height", "", 1.0, ROLLED_PRIOR),
            Unknown("shear_ratio", "stiffness in shear over an isotropic plate's", "", 1.0, ROLLED_PRIOR),
        ]
    if p.corner_radius_mm:
        found.append(Unknown("corner", "corner radius", "mm", p.corner_radius_mm, p.corner_radius_uncertainty_mm))
    for side, kind in held_sides(said).items():
        start = start_of(kind, float(np.mean(chirp.band_hz)))
        found += [
            Unknown(f"{side} {each}", f"edge {each}, {side}", "", value, prior)
            for each, value, prior in zip(KINDS, start.values, start.priors, strict=True)
        ]
    for k, one in enumerate(said.scatterers):
        starts = (*one.at_mm, one.diameter_mm / 2, 0.0, 0.0)
        priors = (one.uncertainty_mm, one.uncertainty_mm, RADIUS_PRIOR * one.diameter_mm / 2, *SCATTERER_PRIORS)
        found += [
            Unknown(f"scatterer {each} {k}", f"scatterer {k + 1} {each}", unit, start, prior)
            for each, unit, start, prior in zip(SCATTERER, SCATTERER_UNITS, starts, priors, strict=True)
        ]
    places, bonds, beads, masses = (list[Unknown]() for _ in range(4))
    for k, place in enumerate(said.layout().centres_mm):
        disc = f"receiver {k}" if k else "emitter"
        for axis, value in zip("xy", place, strict=True):
            places.append(Unknown(f"{axis}{k}", f"{disc} {axis}", "mm", float(value), d.uncertainty_mm))
            beads.append(Unknown(f"bead {axis}{k}", f"disc bead {axis}, {disc}", "mm", 0.0, BEAD_MM_PRIOR))
        bonds.append(Unknown(f"stiffness {k}", f"disc stiffer, {disc}", "1e-7 m^3", 0.0, BOND_PRIOR * stiff))
        masses.append(Unknown(f"bead mass {k}", f"disc bead, {disc}", "g", BEAD_G, BEAD_G_PRIOR))
    return (*found, *places, *bonds, *beads, *masses)


def lever_mm_of(said: PlateFile) -> float:
    """Return the height of the discs' middle over the plate's."""
    return (said.plate.thickness_mm + DISC_THICKNESS_MM) / 2


def disc_stiffness_of(said: PlateFile) -> float:
    """Return what a bonded disc stiffens the plate by, in the unit of stiffness: a sheet at its height that bends.

    It is less on metal and thin panes, to a ninth; at most 1, as on plastics a disc may be stiffer by far without
    telling so.
    """
    face, height = said.discs.diameter_mm / 6, lever_mm_of(said) / 3.5
    return min(face**2 * height**2 * MATERIALS["glass"].E_pa / said.plate.elastic.E_pa, 1.0)


def held_sides(said: PlateFile) -> dict[str, str]:
    """Return what holds each side that is not free."""
    return {side: kind for side, kind in said.plate.edges.model_dump().items() if kind != "free"}


class Reader:
    """Reads vectors of a plate's unknowns."""

    def __init__(self, said: PlateFile, acquisition: Acquisition) -> None:
        self.unknowns = unknowns_of(said, acquisition.chirp)
        self.names = tuple(unknown.name for unknown in self.unknowns)
        self.start = np.array([unknown.start for unknown in self.unknowns])
        self.prior = np.array([unknown.prior for unknown in self.unknowns])
        self._at = {name: i for i, name in enumerate(self.names)}
        first = [self._at[name] for name in ("x0", "stiffness 0", "bead x0", "bead mass 0")]
        self._places, self._bonds, self._beads, self._masses = starmap(slice, pairwise([*first, None]))
        self.places = self.names[self._places]
        """Names of the discs' coordinates."""
        self.joints = self.names[self._bonds.start :]
        """Names of what differs from disc to disc: how stiff the bond is, and the bead."""
        self.held = held_sides(said)
        """What holds each side that is not free."""
        self.edges = tuple(f"{side} {kind}" for side in self.held for kind in KINDS)
        """Names of the edges' unknowns, for example `left damping`."""
        self.rolled = tuple(name for name in ROLLED if name in self._at)
        """Names of what a rolled sheet has."""
        self.corner = tuple(name for name in self.names if name == "corner")
        """Name of the corners' radius, of rounded ones."""
        self.scatterers = tuple(name for name in self.names if name.startswith("scatterer "))
        """Names of the scatterers' numbers."""
        self._plate, self._layout = said.twin_plate(), said.layout()
        self._said = shape_of(self._plate)
        self._gram_m3 = 1e-3 / material_of(self._plate).rho_kg_m3
        self._scatterer_units = (1e-3, 1e-3, 1e-3, self._gram_m3, STIFFNESS_M3)
        self._gyration2_m2 = 1e-6 * (lever_mm_of(said) ** 2 + said.discs.diameter_mm**2 / 16)
        chirp = acquisition.chirp
        self._middle = np.pi * (chirp.start_hz + chirp.stop_hz)

    def index(self, names: tuple[str, ...]) -> NDArray[np.intp]:
        """Return where names stand in a vector."""
        return np.array([self._at[name] for name in names], np.intp)

    def starting_at(self, p: Floats, other: Reader) -> Floats:
        """Return the start, with what another reader's vector says of the unknowns that both have."""
        found = self.start.copy()
        found[self.index(other.names)] = p
        return found

    def read(self, p: Floats) -> Guess:
        """Return what a vector says, in SI units."""
        v = dict(zip(self.names, p.tolist(), strict=True))
        s, layout = self._said, self._layout
        orthotropy, shear_ratio = (float(np.clip(v.get(name, 1.0), *ROLLED_RANGE)) for name in ROLLED)
        shape = Shape(
            s.speed2 * np.exp(2 * v["speed"]), s.h * np.exp(v["thickness"]), v["poisson"],
            v["width"] * 1e-3, v["height"] * 1e-3, max(v["plane"], LEAST_PLANE),
            orthotropy, shear_ratio,
            1e-3 * max(v["corner"], LEAST_CORNER_MM) if self.corner else 0.0,
        )  # fmt: skip
        discs = Discs(
            p[self._places].reshape(-1, 2) * 1e-3,
            layout.diameter_mm / 2e3 * np.exp(v["radius"]),
            layout.mass_g * self._gram_m3 * np.exp(v["mass"]),
            STIFFNESS_M3 * (v["stiffness"] + p[self._bonds]),
            max(self._gyration2_m2 * v["gyration"], 0.0),
            p[self._beads].reshape(-1, 2) * 1e-3,
            np.maximum(p[self._masses], 0.0) * self._gram_m3,
            self._scatterers(p),
            max(1e3 * v["stretch"], 0.0),
        )
        edges = Edges(self.held, {name: v[name] for name in self.edges}, self._middle)
        return Guess(shape, discs, Loss(float(np.exp(v["loss"])), v["slope"], self._middle), edges)

    def without_scatterers(self, p: Floats) -> Floats:
        """Return a vector of the same plate without its scatterers."""
        found = p.copy()
        found[self.index(tuple(name for name in self.scatterers if "mass" in name or "stiffness" in name))] = 0.0
        return found

    def _scatterers(self, p: Floats) -> Floats:
        """Return them as `Discs` has them."""
        found = p[self.index(self.scatterers)].reshape(-1, len(SCATTERER)) * self._scatterer_units
        found[:, 2] = np.maximum(found[:, 2], 1e-3 * LEAST_RADIUS_MM)
        return found

    def chain(self, p: Floats) -> dict[str, tuple[str, float]]:
        """Return, for each unknown, the name of the response's derivative and the factor to it."""
        shape, discs, _, _ = self.read(p)
        found = {
            "speed": ("speed2", 2 * shape.speed2), "thickness": ("h", shape.h), "loss": ("loss", 1.0),
            "poisson": ("nu", 1.0), "width": ("width", 1e-3), "height": ("height", 1e-3), "slope": ("slope", 1.0),
            "mass": ("mass", discs.mass_kg_m3), "radius": ("radius", discs.radius_m),
            "stiffness": ("stiffness", STIFFNESS_M3), "gyration": ("gyration2", self._gyration2_m2),
            "stretch": ("stretch", 1e3), "plane": ("plane", 1.0), **{name: (name, 1.0) for name in self.rolled},
            **{name: (name, 1e-3) for name in self.corner},
        }  # fmt: skip
        found |= {name: (name, 1.0) for name in self.edges}
        found |= {name: (name, unit) for name, unit in zip(self.scatterers, cycle(self._scatterer_units))}
        units = (self._places, 1e-3), (self._bonds, STIFFNESS_M3), (self._beads, 1e-3), (self._masses, self._gram_m3)
        return found | {name: (name, unit) for some, unit in units for name in self.names[some]}

    def plate(self, p: Floats) -> ElasticPlate:
        """Return the plate of a vector, its sides to a micrometre, as models describe them.

        The density is the one said, as only the wave speed counts.
        """
        shape, rho = self.read(p).shape, material_of(self._plate).rho_kg_m3
        return ElasticPlate(
            width_mm=round(shape.width * 1e3, 3), height_mm=round(shape.height * 1e3, 3),
            thickness_mm=round(shape.h * 1e3, 6),
            material=self._plate.material,
            elastic=Material(shape.speed2 * rho, shape.nu, rho, shape.orthotropy, shape.shear_ratio),
            corner_radius_mm=round(shape.corner * 1e3, 3),
        )  # fmt: skip

    def layout(self, p: Floats) -> Layout:
        """Return the discs of a vector."""
        guess, rho = self.read(p), material_of(self._plate).rho_kg_m3
        discs = guess.discs
        places = [(float(x), float(y)) for x, y in 1e3 * discs.centres_m]
        return Layout(
            emitter_mm=places[0], receivers_mm=tuple(places[1:]), diameter_mm=2e3 * discs.radius_m,
            mass_g=1e3 * rho * discs.mass_kg_m3,
            stiffnesses_n_m=tuple((rho * guess.shape.speed2 * discs.stiffness_m3).tolist()),
            lever_mm=1e3 * np.sqrt(discs.lever2_m2), spread=discs.spread,
            beads_mm=tuple(map(tuple, (1e3 * discs.beads_m).tolist())),
            beads_g=tuple((1e3 * rho * discs.beads_kg_m3).tolist()), stretch_per_mm=1e-3 * discs.stretch_per_m,
            scatterers=tuple(
                Scatterer(at_mm=(1e3 * x, 1e3 * y), diameter_mm=2e3 * radius, mass_g=1e3 * rho * mass,
                          stiffness_n_m=rho * guess.shape.speed2 * stiffness)
                for x, y, radius, mass, stiffness in discs.scatterers.tolist()
            ),
        )  # fmt: skip

    def shown(self, p: Floats) -> Floats:
        """Return the vector in the units that a person reads."""
        plate, layout, loss = self.plate(p), self.layout(p), self.read(p).loss
        m = plate.elastic
        first = [np.sqrt(m.E_pa / m.rho_kg_m3), plate.thickness_mm, loss.factor, m.nu, plate.width_mm, plate.height_mm]
        return np.array([*first, loss.slope, layout.mass_g, layout.diameter_mm,
                         max(p[self._at["stiffness"]], 0.0),  # as it is read
                         max(p[self._at["gyration"]] * self._gyration2_m2 * 1e6, 0.0),
                         *p[self._at["gyration"] + 1 : self._masses.start], *layout.beads_g])  # fmt: skip
