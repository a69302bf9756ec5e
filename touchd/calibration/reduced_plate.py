"""The free plate near a reference plate: its eigenproblem in the reference's modes.

Strain and kinetic energy of Mindlin's plate are sums of thirteen forms that depend on the modes alone, times factors
that depend on elastic constants, thickness, width and height alone; those of waves in its plane of six. In
coordinates scaled by width and height the modes of one plate are a basis for those of all similar ones, so another
plate costs an eigenproblem of a few hundred unknowns, and a parameter's derivative a product with a small matrix.

Energies are per mass of the plate: a mode has the mass 1 if it carries the plate's whole mass.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from touchd.twin.physics import in_plane, legendre
from touchd.twin.physics.material import ElasticPlate, Material, material_of, stiffness_of
from touchd.twin.physics.plate import (
    LEAST_MARGIN,
    MANY_POLYNOMIALS,
    ClassModes,
    Slices,
    polynomials_for,
    solve_classes,
)
from touchd.twin.physics.transducer import Layout, LoadedModes, vectors_of, with_discs

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Array = TypeVar("Array", Floats, Complex)

BASIS, BASIS_OF_MANY = 3.0, 1.8
"""Modes up to this many times the highest frequency are the basis; fewer where a plate has thousands."""
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


SHAPE_NAMES = Shape._fields


def shape_of(plate: ElasticPlate) -> Shape:
    """Return what the modes of a plate depend on."""
    m = material_of(plate)
    speed2, h = m.E_pa / m.rho_kg_m3, plate.thickness_mm * 1e-3
    return Shape(
        speed2, h, m.nu, plate.width_mm * 1e-3, plate.height_mm * 1e-3,
        orthotropy=m.orthotropy, shear_ratio=m.shear_ratio,
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
        self.classes = [_class_of(each, unit, self.counts) for each in bending]
        self.classes += [_class_in_plane(each, unit, plane_counts) for each in plane]
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
        (stiff, heavy), (_, there) = _factors(shape), _factors(self.reference)
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
        ends = [_factors(shape._replace(**{name: getattr(shape, name) + sign * step})) for sign in (1, -1)]
        stiff, heavy = (
            {number: (above[number] - below[number]) / (2 * step) for number in above}
            for above, below in zip(*ends, strict=True)
        )
        return [
            each.sums((stiff, heavy)) if stiff[len(each.stiff)].any() or heavy[len(each.heavy)].any() else None
            for each in self.classes
        ]

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


def _factors(s: Shape) -> _Factors:
    """Return the factors of a class' forms."""
    across, W, H = (s.h * s.nu / (1 - s.nu)) ** 2 / 12, s.width, s.height
    stiff = _stiff_factors(s), s.plane * _plane_factors(s)
    heavy = np.array([s.h**2 / 12]), np.array([across / W**2, across / H**2, 2 * across / (W * H)])
    return {len(each): each for each in stiff}, {len(each): each for each in heavy}


def _class_of(modes: ClassModes, unit: float, counts: tuple[int, int]) -> _Class:
    """Return the energies' forms between the modes of one class of bending waves."""
    w, px, py = (unit * field for field in modes.fields)
    along = _Along(modes, counts)
    w_x, w_y = along.x(w, 0), along.y(w, 0)
    stiff = along.plane(px, py)
    stiff += [_form(a, b) for a, b in ((w_x, w_x), (w_x, px), (px, px), (w_y, w_y), (w_y, py), (py, py))]
    return _Class(_flat(w, px, py), modes.places, stiff, [stiff[8] + stiff[11]])


def _class_in_plane(modes: ClassModes, unit: float, counts: tuple[int, int]) -> _Class:
    """Return the energies' forms between the modes of one class of waves in the plane."""
    nothing, u, v = (unit * field for field in modes.fields)
    stiff = _Along(modes, counts).plane(u, v)
    return _Class(_flat(nothing, u, v), modes.places, stiff, stiff[:3])


class _Along:
    """Derivatives of a class' fields on the unit square."""

    def __init__(self, modes: ClassModes, counts: tuple[int, int]) -> None:
        self._places, self._d = modes.places, [legendre.derivative(1.0, count) for count in counts]

    def x(self, values: Floats, field: int) -> Floats:
        own = self._places[field][0]
        return np.asarray(np.einsum("ij,njk->nik", self._d[0][_other(own), own], values, optimize=True))

    def y(self, values: Floats, field: int) -> Floats:
        own = self._places[field][1]
        return np.asarray(values @ self._d[1][_other(own), own].T)

    def plane(self, a: Floats, b: Floats) -> list[Floats]:
        """Return the six forms of the strain energy of fields along x and y: rotations, or displacements."""
        a_x, a_y, b_x, b_y = self.x(a, 1), self.y(a, 1), self.x(b, 2), self.y(b, 2)
        return [_form(*pair) for pair in ((a_x, a_x), (b_y, b_y), (a_x, b_y), (a_y, a_y), (b_x, b_x), (a_y, b_x))]


def _form(a: Floats, b: Floats) -> Floats:
    product = a.reshape(len(a), -1) @ b.reshape(len(b), -1).T
    return product if a is b else (product + product.T) / 2


def _flat(*fields: Floats) -> tuple[Floats, Floats, Floats]:
    w, a, b = (field.reshape(len(field), -1) for field in fields)
    return w, a, b


def _other(own: slice) -> slice:
    """Return the polynomials of the other parity: a derivative turns even ones into odd ones."""
    return slice(1 - own.start, own.stop, 2)
