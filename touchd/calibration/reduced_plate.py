"""The free plate near a reference plate: its eigenproblem in the reference's modes.

Strain and kinetic energy of Mindlin's plate are sums of thirteen forms that depend on the modes alone, times factors
that depend on elastic constants, thickness, width and height alone; those of waves in its plane of six. In
coordinates scaled by width and height the modes of one plate are a basis for those of all similar ones, so another
plate costs an eigenproblem of a few hundred unknowns, and a parameter's derivative a product with a small matrix.

Energies are per mass of the plate: a mode has the mass 1 if it carries the plate's whole mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from touchd.calibration import energy_forms
from touchd.calibration.energy_forms import Pair
from touchd.twin.physics import in_plane
from touchd.twin.physics.material import ElasticPlate, Material, corner_radius_m, material_of, stiffness_of
from touchd.twin.physics.plate import (
    LEAST_MARGIN,
    MANY_POLYNOMIALS,
    ClassModes,
    Slices,
    modes_of,
    polynomials_for,
    solve_classes,
)
from touchd.twin.physics.transducer import Layout, LoadedModes, vectors_of, with_discs

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Array = TypeVar("Array", Floats, Complex)

BASIS, BASIS_OF_MANY = 3.0, 1.8
"""Modes up to this many times the highest frequency are the basis; fewer where a plate has thousands."""
MOST_GROWN = 1.3
"""Area of the pieces beyond rounded corners over the reference's, at most: beyond, a change that is linear in the area
takes away more mass than there is."""
IN_PLANE, IN_PLANE_OF_MANY = 1.3, 1.05
"""The same of modes in the plate's plane: with twice as many a fit leaves half of 2e-4 (twin)."""


class Shape(NamedTuple):
    """What the modes of a free plate depend on."""

    speed2: float
    """Young's modulus over density, m^2/s^2."""
    h: float
    """Thickness, m."""
    nu: float
    width: float
    """Width and height, m."""
    height: float
    plane: float = 1.0
    """Stiffness in the plane over mass, over what `speed2` says: what is bonded on a plate loads its bending waves, and
    otherwise those in its plane."""
    orthotropy: float = 1.0
    shear_ratio: float = 1.0
    """As `Material` has them."""
    corner: float = 0.0
    """Radius of the corners, m."""


SHAPE_NAMES = Shape._fields


def shape_of(plate: ElasticPlate) -> Shape:
    """Return what the modes of a plate depend on."""
    m = material_of(plate)
    speed2, h = m.E_pa / m.rho_kg_m3, plate.thickness_mm * 1e-3
    return Shape(
        speed2, h, m.nu, plate.width_mm * 1e-3, plate.height_mm * 1e-3,
        orthotropy=m.orthotropy, shear_ratio=m.shear_ratio, corner=corner_radius_m(plate),
    )  # fmt: skip


def _stiff_factors(s: Shape) -> Floats:
    """Return the factors of the strain energy's twelve forms."""
    shear = 5 / (6 - s.nu) * s.speed2 / (2 * (1 + s.nu))
    W, H = s.width, s.height
    return np.array([
        *(s.h**2 / 12 * _plane_factors(s)), shear / W**2, 2 * shear / W, shear, shear / H**2, 2 * shear / H, shear,
    ])  # fmt: skip


def _plane_factors(s: Shape) -> Floats:
    """Return the factors of the six forms of the strain energy in the plane."""
    along_x, along_y, between, shear = Material(s.speed2, s.nu, 1.0, s.orthotropy, s.shear_ratio).in_plane()  # per mass
    W, H = s.width, s.height
    return np.array([
        along_x / W**2, along_y / H**2, 2 * between / (W * H), shear / H**2, shear / W**2, 2 * shear / (W * H),
    ])  # fmt: skip


_Factors = tuple[dict[int, Floats], dict[int, Floats]]
"""Those of the forms of the strain energy, by how many forms a class has, and of the kinetic energy."""


class _Class(NamedTuple):
    """The basis modes of one parity: n modes, that bend the plate or lie in its plane."""

    fields: tuple[Floats, Floats, Floats]
    """Coefficients of w, psi_x and psi_y, or of nothing, u and v, in products of polynomials on the unit square, each
    (n, a b)."""
    places: tuple[Slices, Slices, Slices]
    """Where these stand among all, along x and y."""
    stiff: list[Floats]
    """Twelve or six forms of the strain energy, each (n, n)."""
    heavy: list[Floats]
    """Forms of the kinetic energy, of rotations or of the motion across; the rest follows from the reference's unit
    mass."""

    def sums(self, factors: _Factors) -> tuple[Floats, Floats]:
        """Return stiffness and mass, both (n, n): the forms times their factors."""
        K, M = (
            sum(factor * form for form, factor in zip(forms, by_number[len(forms)].tolist(), strict=True))
            for forms, by_number in zip((self.stiff, self.heavy), factors, strict=True)
        )
        return np.asarray(K), np.asarray(M)


class BareModes(NamedTuple):
    """Modes of the free plate in the reference's modes."""

    omega2: Floats
    """Squares of angular frequencies, shape (n,), class by class."""
    turns: list[Floats]
    """For each class, the modes in the reference's, shape (n, n): column k is mode k."""


class ReducedPlate:
    """Free plates of constants near those of the reference `plate`, exact up to `highest_hz`."""

    def __init__(self, plate: ElasticPlate, highest_hz: float) -> None:
        self.reference = shape_of(plate)
        self.counts = polynomials_for(plate, highest_hz, LEAST_MARGIN)
        many = max(self.counts) > MANY_POLYNOMIALS - 10
        basis, beside = (BASIS_OF_MANY, IN_PLANE_OF_MANY) if many else (BASIS, IN_PLANE)
        unit = float(np.sqrt(stiffness_of(plate).mass))
        bending = solve_classes(plate, self.counts, basis * highest_hz)
        plane_counts = in_plane.polynomials_for(plate, highest_hz)
        plane = in_plane.solve_classes(plate, plane_counts, beside * highest_hz)
        self.classes = [
            _class_of(each, unit, counts, self.reference)
            for classes, counts in ((bending, self.counts), (plane, plane_counts))
            for each in classes
        ]
        modes = [len(each.stiff[0]) for each in self.classes]
        self.in_plane = np.repeat(np.arange(len(modes)) >= len(bending), modes)
        """Which modes lie in the plane, shape (n,): they have u and v where others have rotations."""
        self._last: tuple[Shape, BareModes] | None = None

    def solve(self, shape: Shape) -> BareModes:
        """Return the modes of another plate; where the wave speed alone is another, they are the last ones'."""
        unit = shape._replace(speed2=self.reference.speed2)
        if self._last is None or self._last[0] != unit:
            self._last = unit, self._solve(unit)
        modes = self._last[1]
        return modes._replace(omega2=modes.omega2 * (shape.speed2 / unit.speed2))

    def _solve(self, shape: Shape) -> BareModes:
        (stiff, heavy), (_, there) = self._factors(shape), self._factors(self.reference)
        more = {number: factors - there[number] for number, factors in heavy.items()}
        omega2, turns = [], []
        for each in self.classes:
            K, mass = each.sums((stiff, more))
            mass[np.diag_indices(len(mass))] += 1
            squares, turn = modes_of(K, mass)
            omega2.append(np.maximum(squares, 0.0))
            turns.append(turn)
        return BareModes(np.concatenate(omega2), turns)

    def loaded(self, plate: ElasticPlate, layout: Layout) -> LoadedModes:
        """Return another plate's modes with discs: all of them, as with fewer a disc would yield otherwise."""
        bare = self.solve(shape_of(plate))
        unit = np.sqrt(stiffness_of(plate).mass)
        vectors = self.turned(vectors_of(layout, plate, self.counts, self.sums, self.in_plane), bare) / unit
        omega, V = with_discs(np.sqrt(bare.omega2), vectors, layout)
        w = np.empty((len(omega), *self.counts))
        for turn, part, each in zip(bare.turns, self.to_classes(V.T), self.classes, strict=True):
            along_x, along_y = each.places[0]
            values = (turn @ part).T @ (each.fields[0] / unit)
            w[:, along_x, along_y] = values.reshape(w[:, along_x, along_y].shape)
        return LoadedModes(omega, w, V @ vectors[:, : len(layout.centres_mm)])

    def slopes(self, shape: Shape, name: str) -> list[tuple[Floats, Floats] | None]:
        """Return, for each class, the derivatives (n, n) of stiffness and mass; None where there are none."""
        step = 1e-4 * getattr(shape, name)
        ends = [self._factors(shape._replace(**{name: getattr(shape, name) + sign * step})) for sign in (1, -1)]
        stiff, heavy = (
            {number: (above[number] - below[number]) / (2 * step) for number in above}
            for above, below in zip(*ends, strict=True)
        )
        return [
            each.sums((stiff, heavy)) if stiff[len(each.stiff)].any() or heavy[len(each.heavy)].any() else None
            for each in self.classes
        ]

    def _factors(self, s: Shape) -> _Factors:
        """Return the factors of a class' forms: of each form, and where corners are rounded of its slope, too."""
        across, W, H = (s.h * s.nu / (1 - s.nu)) ** 2 / 12, s.width, s.height
        stiff = [_stiff_factors(s), s.plane * _plane_factors(s)]
        heavy = [np.array([s.h**2 / 12]), np.array([across / W**2, across / H**2, 2 * across / (W * H)])]
        if radius := self.reference.corner:
            grown = (1 - min((s.corner / radius) ** 2, MOST_GROWN)) / 2  # as the pieces' area
            stiff = [np.concatenate([each, grown * each]) for each in stiff]
            heavy = [np.concatenate([each, grown * each, [grown]]) for each in heavy]
        return {len(each): each for each in stiff}, {len(each): each for each in heavy}

    def turned(self, values: Floats, bare: BareModes) -> Floats:
        """Turn values in the reference's modes (n, k) into another plate's, class by class."""
        split = self.to_classes(values)
        return np.concatenate([turn.T @ part for turn, part in zip(bare.turns, split, strict=True)])

    def to_classes(self, values: Array) -> list[Array]:
        """Split values of the reference's modes, shape (n, ...), by class."""
        return np.split(values, np.cumsum([len(each.stiff[0]) for each in self.classes])[:-1])

    def sums(self, field: int, weights: Floats) -> Floats:
        """Return sums of a field's coefficients, of w, psi_x or psi_y, times weights (k, nx, ny), shape (n, k)."""
        found = []
        for each in self.classes:
            along_x, along_y = each.places[field]
            found.append(each.fields[field] @ weights[:, along_x, along_y].reshape(len(weights), -1).T)
        return np.concatenate(found)


def _class_of(modes: ClassModes, unit: float, counts: tuple[int, int], shape: Shape) -> _Class:
    """Return the energies' forms between the modes of one class, that bend the plate or lie in its plane."""
    fields = energy_forms.fields_of(modes, unit, counts, (shape.width, shape.height), shape.corner)
    (w, a, b), plane = fields.values, energy_forms.in_plane(fields)

    def energies(of: Callable[[Sequence[Pair]], list[Floats]]) -> tuple[list[Floats], list[Floats], Floats]:
        stiff, squares = of(plane), of([(w, w), (a, a), (b, b)])
        if not modes.fields[0].size:
            return stiff, stiff[:3], squares[1] + squares[2]
        return stiff + of(energy_forms.across(fields)), [squares[1] + squares[2]], squares[0]

    stiff, heavy, _ = energies(energy_forms.forms)
    if shape.corner:
        more = energies(energy_forms.taken)
        stiff, heavy = stiff + more[0], [*heavy, *more[1], more[2]]
    return _Class((w.whole, a.whole, b.whole), modes.places, stiff, heavy)
