"""Response between the discs of a plate, and its derivatives by everything that a fit may change.

A disc is nine means over it: the outward rotation around its rim, by which it drives and senses, and the two other
rotations around it, which its bending stiffness resists; the deflection and its two slopes, which carry its mass; the
plate's two rotations, which move it in the plane, as it lies below the plate's middle; and the deflection under the
bead of solder and glue where its cable leaves. What holds an edge is more such vectors: `loads`. How the loaded plate
follows from them: `loaded_plate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from touchd.calibration.loaded_plate import Load, LoadedPlate, heard, times
from touchd.calibration.loads import LEAST_RATIO, SCATTERER, Guess, Lines, cell_vectors, disc_vectors, vectors_of
from touchd.calibration.reduced_plate import SHAPE_NAMES, Complex, Floats, ReducedPlate
from touchd.twin.physics import legendre
from touchd.twin.physics.transducer import CELL_MASS, CELL_STIFFNESS, CELLS, MEANS, OTHER_BENDING

_PLACE_STEP_M, _STRETCH_STEP_PER_M = 1e-6, 0.1


class DiscResponse:
    """Response of a plate with D discs at complex angular frequencies: F frequencies, R receivers, V vectors.

    `nu_rad_s` has shape (F,); without `lines` no side is held.
    """

    def __init__(self, plate: ReducedPlate, guess: Guess, nu_rad_s: Complex, lines: Lines | None = None) -> None:
        self._plate, self._nu, self._lines = plate, nu_rad_s, lines
        self._shape, self._discs, self._loss, self._edges = shape, discs, loss, edges = guess
        self._bare = plate.solve(shape)
        vectors = vectors_of(plate, shape, discs)
        every = np.concatenate([vectors, lines.vectors], axis=1) if lines else vectors
        self._phi = plate.turned(every, self._bare)
        stiff: Complex = np.asarray(1 + 1j * loss.at(nu_rad_s), np.complex128)
        nu2: Complex = nu_rad_s**2
        D = len(discs.centres_m)
        volume = shape.h * shape.width * shape.height
        spring, inert = shape.speed2 / volume, 1 / volume
        # Loads of the discs' vectors, by what they are proportional to, shape (MEANS D,).
        other, lever2, spread = OTHER_BENDING, discs.lever2_m2, discs.spread
        by_stiffness = spring * np.repeat([1, other, other, 0, 0, 0, 0, 0, 0], D)
        by_mass = inert * np.repeat([0, 0, 0, 1, lever2, lever2, spread, spread, 0], D)
        self._per_stiffness, self._per_mass = stiff[:, None] * by_stiffness, -nu2[:, None] * by_mass
        self._inert = -nu2[:, None] * inert
        heavy, lifted = discs.mass_kg_m3 * self._inert, lever2 > 0
        rolls, tilts = np.repeat([0, 0, 0, 0, 1, 1, 0, 0, 0], D), np.repeat([0, 0, 0, 0, 0, 0, 1, 1, 0], D)
        self._per_gyration2 = heavy * rolls if lifted else heavy / discs.face_m2 * tilts
        # A wider disc of the same gyration rolls less, and its slopes are means over a wider face.
        self._by_face = self._per_gyration2 * (1.0 if lifted else discs.spread)
        # Of each scatterer, likewise: (CELLS times its means,).
        cells = spring * np.repeat(CELL_STIFFNESS, CELLS), inert * np.repeat(CELL_MASS, CELLS)
        self._per_scatterer = -nu2[:, None] * cells[1], stiff[:, None] * cells[0]
        masses = discs.mass_kg_m3 * by_mass
        masses[-D:] = discs.beads_kg_m3 * inert
        springs = np.tile(discs.stiffness_m3, MEANS) * by_stiffness
        load = Load(
            np.concatenate([springs, *np.outer(discs.scatterers[:, 4], cells[0])]),
            np.concatenate([masses, *np.outer(discs.scatterers[:, 3], cells[1])]),
            np.zeros((len(nu2), 0), complex),
        )
        self._held = len(load.masses)
        self._stiff_load, self._disc_load = stiff[:, None] * load.springs, load.at(stiff, nu_rad_s)
        self._per_edge: dict[str, Complex] = {}
        if lines:
            self._per_edge = lines.loads(edges.middle_rad_s, nu_rad_s, stiff)
            load = lines.added(load, edges, self._per_edge)
        self._load = load.at(stiff, nu_rad_s)  # (F, V)
        self._loaded = LoadedPlate(plate, self._bare, self._phi, load, stiff, nu_rad_s, D)
        self._G = self._loaded.found
        """What each vector of the loaded plate answers to each disc, shape (F, V, D)."""

    def untouched(self) -> Complex:
        """Return the response of each receiver, shape (R, F)."""
        return np.asarray(self._G[:, 0, 1:].T)

    def between(self) -> Complex:
        """Return the response between any two discs, shape (D, D, F)."""
        return np.asarray(self._G[:, : self._G.shape[2]].transpose(1, 2, 0))

    def at(self, places_m: Floats) -> Complex:
        """Return the loaded plate's answer to each disc's rotation at places (k, 2), shape (D, k, F)."""
        sides, counts = (self._shape.width, self._shape.height), self._plate.counts
        x, y = (legendre.values(places_m[:, i], sides[i], counts[i]) for i in (0, 1))
        points = np.sqrt(sides[0] * sides[1]) * self._plate.sums(0, x[:, :, None] * y[:, None])
        shapes = self._plate.turned(points, self._bare).T
        return self._heard(shapes).transpose(1, 0, 2)

    def slopes(self, names: set[str]) -> dict[str, Complex]:
        """Return the derivatives (R, F) by the named parameters.

        Names are those of `Shape`, `loss`, `slope` (both by the logarithm, or the exponent), `mass`, `stiffness`,
        `gyration2`, `radius`, `stretch`; of single discs `x0`, `y0`, `x1` .. of the centres, `stiffness 0` .. and, of
        the beads, `bead x0` .. and `bead mass 0` .., all in SI units; and those of `Edges.values`.
        """
        d, D = self._discs, len(self._discs.centres_m)
        moves = {
            prefix + axis: (field, _PLACE_STEP_M, along)
            for prefix, field in (("", "centres_m"), ("bead ", "beads_m"))
            for axis, along in zip("xy", np.eye(2), strict=True)
            if any(f"{prefix}{axis}{k}" in names for k in range(D))
        }
        steps = {"radius": ("radius_m", 1e-3 * d.radius_m), "stretch": ("stretch_per_m", _STRETCH_STEP_PER_M)}
        moves |= {name: (*step, np.array(1.0)) for name, step in steps.items() if name in names}
        across = self._across_discs(moves)
        found: dict[str, Complex] = {}
        for axis, k in product(moves.keys() - steps.keys(), range(D)):
            if f"{axis}{k}" in names:
                own = np.zeros_like(across[axis])  # the other discs' vectors stay
                own[:, k : MEANS * D : D] = across[axis][:, k : MEANS * D : D]
                found[f"{axis}{k}"] = self._by_vectors(own)
        for k, at in product(range(len(d.scatterers)), range(5)):
            if (name := f"scatterer {SCATTERER[at]} {k}") in names:
                found[name] = self._by_scatterer(k, at)
        if "radius" in names:
            found["radius"] = self._by_vectors(across["radius"]) + d.radius_m / 2 * self._weighed(self._by_face)
        if "stretch" in names:
            found["stretch"] = self._by_vectors(across["stretch"])
        loads = {"mass": self._per_mass, "stiffness": self._per_stiffness, "gyration2": self._per_gyration2}
        found |= {name: -self._weighed(loads[name]) for name in loads if name in names}
        for k in range(D):
            if f"bead mass {k}" in names:
                found[f"bead mass {k}"] = -self._weighed(self._inert, (MEANS - 1) * D + k)
            if f"stiffness {k}" in names:
                found[f"stiffness {k}"] = -self._weighed(self._per_stiffness * np.tile(np.arange(D) == k, MEANS))
        found |= {name: -self._weighed(load, self._held) for name, load in self._per_edge.items() if name in names}
        if names & {"loss", "slope", *SHAPE_NAMES}:
            found.update(self._by_plate(names))
        return found

    def _by_scatterer(self, k: int, at: int) -> Complex:
        """Return the derivative (R, F) by a number of one scatterer."""
        D = len(self._discs.centres_m)
        if at >= 3:
            return -self._weighed(self._per_scatterer[at - 3], MEANS * D + len(CELL_MASS) * CELLS * k)
        along = np.zeros_like(self._discs.scatterers)
        along[k, at] = _PLACE_STEP_M
        ends = (self._discs._replace(scatterers=self._discs.scatterers + by) for by in (along, -along))
        above, below = (cell_vectors(self._plate, self._shape, end) for end in ends)
        (across,) = self._across([(above - below) / (2 * _PLACE_STEP_M)], MEANS * D)
        return self._by_vectors(across)

    def _weighed(self, load: Floats | Complex, first: int = 0) -> Complex:
        """Return the emitter's and each receiver's answer times loads (F, k) of the vectors from `first`, (R, F)."""
        G = self._G[:, first : first + load.shape[1]]
        return np.asarray(np.einsum("fk,fk,fkr->rf", load, G[..., 0], G[..., 1:]))

    def _heard(self, shapes: Floats) -> Complex:
        """Return what k vectors (k, n) in the free plate's modes find of the answer to each disc, shape (k, D, F)."""
        return heard(shapes, self._loaded.answers)

    def _across(self, changes: Sequence[Floats], first: int = 0) -> list[Complex]:
        """Return what each change of the vectors from `first` on, each (n, k), finds of the answer to each disc.

        Each result has the shape (F, V', D); V' are the discs' vectors and the scatterers'.
        """
        # What stays as it is need not be computed.
        there = [np.flatnonzero(change.any(axis=0)) for change in changes]
        every = np.concatenate([change[:, at] for change, at in zip(changes, there, strict=True)], axis=1)
        heard = self._heard(self._plate.turned(every, self._bare).T).transpose(2, 0, 1)
        found = np.zeros((len(changes), len(heard), self._held, heard.shape[2]), complex)
        ends = np.cumsum([len(at) for at in there])[:-1]
        for across, at, own in zip(found, there, np.split(heard, ends, axis=1), strict=True):
            across[:, first + at] = own
        return list(found)

    def _across_discs(self, moves: dict[str, tuple[str, float, Floats]]) -> dict[str, Complex]:
        """Return, for each move, what the derivative of the discs' vectors finds, as `_across` does.

        A move is a field of the discs, the step by which it is moved both ways, and the direction.
        """
        if not moves:
            return {}
        d = self._discs
        ends = [
            d._replace(**{field: getattr(d, field) + by * along})
            for field, step, along in moves.values()
            for by in (step, -step)
        ]
        vectors = disc_vectors(self._plate, self._shape, ends)
        steps = np.array([step for _, step, _ in moves.values()])
        changes = (vectors[::2] - vectors[1::2]) / (2 * steps[:, None, None])
        return dict(zip(moves, self._across(changes), strict=True))

    def _by_vectors(self, across: Complex) -> Complex:
        """Return the derivative (R, F) by a change of discs' vectors that find `across` of the answers."""
        total = across[:, 0, 1:] + across[:, 1 : across.shape[2], 0]
        for k in np.flatnonzero(across.any(axis=(0, 2))):
            load = self._load[:, k, None]
            e, r = self._G[:, k, 0, None], self._G[:, k, 1:]
            total -= load * (across[:, k, 0, None] * r + e * across[:, k, 1:])
        return np.asarray(total.T)

    def _by_plate(self, names: set[str]) -> dict[str, Complex]:
        """Return the derivatives by wave speed, thickness, Poisson's ratio, width, height and loss."""
        D = len(self._discs.centres_m)
        x = self._loaded.answers
        found: dict[str, Complex] = {}
        squares = self._bare.omega2[:, None]
        stiff = 1 + 1j * self._loss.at(self._nu)
        strain = ((squares * x[:, 0])[:, None] * x[:, 1:]).sum(axis=0)
        strain = stiff * strain + self._weighed(self._stiff_load)
        by_loss = -1j * self._loss.at(self._nu) / stiff * strain
        if self._lines:
            elastic = self._lines.elastic(self._edges)
            elastic = np.broadcast_to(elastic, (len(self._nu), elastic.shape[1]))
            by_loss -= 1j * self._loss.at(self._nu) * self._weighed(elastic, self._held)
        if "loss" in names:
            found["loss"] = by_loss
        if "slope" in names:
            found["slope"] = by_loss * np.log(np.maximum(self._nu.real / self._loss.middle_rad_s, LEAST_RATIO))
        in_reference = [heard(turn, own) for turn, own in zip(self._bare.turns, self._plate.to_classes(x), strict=True)]
        for name in names & set(SHAPE_NAMES):
            value = getattr(self._shape, name)
            if name == "speed2":
                found[name] = -strain / value
                continue
            total = np.zeros((D - 1, len(self._nu)), dtype=complex)
            for slope, own in zip(self._plate.slopes(self._shape, name), in_reference, strict=True):
                if slope is None:
                    continue
                K, M = slope
                y = stiff * times(K, own[:, 0])
                if M.any():
                    y -= self._nu**2 * times(M, own[:, 0])
                total -= (y[:, None] * own[:, 1:]).sum(axis=0)
            if name in ("h", "width", "height"):
                total += self._weighed(self._disc_load) / value  # the loads are per mass of the plate
            if name in ("width", "height") or (name == "h" and len(self._discs.scatterers)):
                ends = (self._shape._replace(**{name: (1 + by) * value}) for by in (1e-5, -1e-5))
                above, below = (vectors_of(self._plate, end, self._discs) for end in ends)
                (across,) = self._across([(above - below) / (2e-5 * value)])
                total += self._by_vectors(across)
            found[name] = total
        return found
