"""The free plate near a reference plate: its eigenproblem in the reference's modes.

Strain and kinetic energy of Mindlin's plate are sums of thirteen forms that depend on the modes alone, times factors
that depend on wave speed, thickness, Poisson's ratio, width and height alone. In coordinates scaled by width and height
the modes of one plate are a basis for those of all similar ones, so another plate costs an eigenproblem of a few
hundred unknowns, and a parameter's derivative a product with a small matrix.

Energies are per mass of the plate: a mode has the mass 1 if it carries the plate's whole mass.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from touchd.twin.physics import legendre
from touchd.twin.physics.material import ElasticPlate, material_of, stiffness_of
from touchd.twin.physics.plate import (
    LEAST_MARGIN,
    MANY_POLYNOMIALS,
    ClassModes,
    Slices,
    polynomials_for,
    size_m,
    solve_classes,
)
from touchd.twin.physics.transducer import Layout, LoadedModes, vectors_of, with_discs

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Array = TypeVar("Array", Floats, Complex)

BASIS, BASIS_OF_MANY = 3.0, 1.8
"""Modes up to this many times the highest frequency are the basis; fewer where a plate has thousands."""


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


SHAPE_NAMES = Shape._fields


def shape_of(plate: ElasticPlate) -> Shape:
    """Return what the modes of a plate depend on."""
    m = material_of(plate)
    return Shape(m.E_pa / m.rho_kg_m3, plate.thickness_mm * 1e-3, m.nu, plate.width_mm * 1e-3, plate.height_mm * 1e-3)


def _stiff_factors(s: Shape) -> Floats:
    """Return the factors of the strain energy's twelve forms."""
    bend = s.speed2 * s.h**2 / (12 * (1 - s.nu**2))
    twist = bend * (1 - s.nu) / 2
    shear = 5 / (6 - s.nu) * s.speed2 / (2 * (1 + s.nu))
    W, H = s.width, s.height
    return np.array([
        bend / W**2, bend / H**2, 2 * bend * s.nu / (W * H), twist / H**2, twist / W**2, 2 * twist / (W * H),
        shear / W**2, 2 * shear / W, shear, shear / H**2, 2 * shear / H, shear,
    ])  # fmt: skip


class _Class(NamedTuple):
    """The basis modes of one parity: n modes."""

    fields: tuple[Floats, Floats, Floats]
    """Coefficients of w, psi_x and psi_y in products of polynomials on the unit square, each (n, a b)."""
    places: tuple[Slices, Slices, Slices]
    """Where these stand among all, along x and y."""
    stiff: list[Floats]
    """Twelve forms of the strain energy, each (n, n)."""
    rotary: Floats
    """Form of the rotations' kinetic energy; that of the deflection follows from the reference's unit mass."""


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
        basis = BASIS_OF_MANY if max(self.counts) > MANY_POLYNOMIALS - 10 else BASIS
        unit = float(np.sqrt(stiffness_of(plate).mass))
        self.classes = [
            _class_of(each, unit, self.counts) for each in solve_classes(plate, self.counts, basis * highest_hz)
        ]
        self._last: tuple[Shape, BareModes] | None = None

    def solve(self, shape: Shape) -> BareModes:
        """Return the modes of another plate; where the wave speed alone is another, they are the last ones'."""
        unit = shape._replace(speed2=self.reference.speed2)
        if self._last is None or self._last[0] != unit:
            self._last = unit, self._solve(unit)
        modes = self._last[1]
        return modes._replace(omega2=modes.omega2 * (shape.speed2 / unit.speed2))

    def _solve(self, shape: Shape) -> BareModes:
        factors, spin = _stiff_factors(shape), (shape.h**2 - self.reference.h**2) / 12
        omega2, turns = [], []
        for each in self.classes:
            K = _sum(each.stiff, factors)
            mass = spin * each.rotary
            mass[np.diag_indices(len(mass))] += 1
            root = np.linalg.cholesky(mass)
            half = np.linalg.solve(root, K)
            squares, vectors = np.linalg.eigh(np.linalg.solve(root, half.T))
            omega2.append(np.maximum(squares, 0.0))
            turns.append(np.linalg.solve(root.T, vectors))
        return BareModes(np.concatenate(omega2), turns)

    def loaded(self, plate: ElasticPlate, layout: Layout) -> LoadedModes:
        """Return another plate's modes with discs: all of them, as with fewer a disc would yield otherwise."""
        bare = self.solve(shape_of(plate))
        unit = np.sqrt(stiffness_of(plate).mass)
        vectors = self.turned(vectors_of(layout, size_m(plate), self.counts, self.sums), bare) / unit
        omega, V = with_discs(np.sqrt(bare.omega2), vectors, layout)
        w = np.empty((len(omega), *self.counts))
        for turn, part, each in zip(bare.turns, self.to_classes(V.T), self.classes, strict=True):
            along_x, along_y = each.places[0]
            values = (turn @ part).T @ (each.fields[0] / unit)
            w[:, along_x, along_y] = values.reshape(w[:, along_x, along_y].shape)
        return LoadedModes(omega, w, V @ vectors[:, : len(layout.centres_mm)])

    def slopes(self, shape: Shape, name: str) -> list[tuple[Floats, float]]:
        """Return, for each class, the derivative (n, n) of the stiffness, and the factor of `rotary` in the mass's."""
        step = 1e-4 * getattr(shape, name)
        up, down = (shape._replace(**{name: getattr(shape, name) + sign * step}) for sign in (1, -1))
        factors = (_stiff_factors(up) - _stiff_factors(down)) / (2 * step)
        return [(_sum(each.stiff, factors), shape.h / 6 if name == "h" else 0.0) for each in self.classes]

    def turned(self, values: Floats, bare: BareModes) -> Floats:
        """Turn values in the reference's modes (n, k) into another plate's, class by class."""
        split = self.to_classes(values)
        return np.concatenate([turn.T @ part for turn, part in zip(bare.turns, split, strict=True)])

    def to_classes(self, values: Array) -> list[Array]:
        """Split values of the reference's modes, shape (n, ...), by class."""
        return np.split(values, np.cumsum([len(each.rotary) for each in self.classes])[:-1])

    def sums(self, field: int, weights: Floats) -> Floats:
        """Return sums of a field's coefficients, of w, psi_x or psi_y, times weights (k, nx, ny), shape (n, k)."""
        found = []
        for each in self.classes:
            along_x, along_y = each.places[field]
            found.append(each.fields[field] @ weights[:, along_x, along_y].reshape(len(weights), -1).T)
        return np.concatenate(found)


def _sum(forms: list[Floats], factors: Floats) -> Floats:
    return np.asarray(sum(factor * form for form, factor in zip(forms, factors, strict=True)))


def _class_of(modes: ClassModes, unit: float, counts: tuple[int, int]) -> _Class:
    """Return the energies' forms between the modes of one class."""
    w, px, py = (unit * field for field in modes.fields)
    d = [legendre.derivative(1.0, count) for count in counts]

    def x(field: int) -> Floats:
        own = modes.places[field][0]
        return np.asarray(np.einsum("ij,njk->nik", d[0][_other(own), own], (w, px, py)[field], optimize=True))

    def y(field: int) -> Floats:
        own = modes.places[field][1]
        return np.asarray((w, px, py)[field] @ d[1][_other(own), own].T)

    def form(a: Floats, b: Floats) -> Floats:
        product = a.reshape(len(a), -1) @ b.reshape(len(b), -1).T
        return product if a is b else (product + product.T) / 2

    px_x, px_y, py_x, py_y, w_x, w_y = x(1), y(1), x(2), y(2), x(0), y(0)
    pairs = [
        (px_x, px_x), (py_y, py_y), (px_x, py_y), (px_y, px_y), (py_x, py_x), (px_y, py_x),
        (w_x, w_x), (w_x, px), (px, px), (w_y, w_y), (w_y, py), (py, py),
    ]  # fmt: skip
    stiff = [form(a, b) for a, b in pairs]
    flat_w, flat_x, flat_y = (field.reshape(len(field), -1) for field in (w, px, py))
    return _Class((flat_w, flat_x, flat_y), modes.places, stiff, stiff[8] + stiff[11])


def _other(own: slice) -> slice:
    """Return the polynomials of the other parity: a derivative turns even ones into odd ones."""
    return slice(1 - own.start, own.stop, 2)
