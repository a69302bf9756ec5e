"""Forms of a plate's energies between the modes of one parity, on the unit square, without constants and sides.

Rounded corners leave the pieces beyond their arcs out. How a form changes as they grow is an integral along the arcs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.twin.physics import corners, legendre
from touchd.twin.physics.plate import ClassModes

Floats = NDArray[np.float64]


class Part(NamedTuple):
    """A field of n modes, or its slope: in orthonormal polynomials (n, k), and at the corners' points times roots."""

    whole: Floats
    beyond: Floats
    """At the points beyond the arcs, times the roots of their weights, (n, Q); of sharp corners there are none."""
    along: Floats
    """Along the arcs, likewise."""


Pair = tuple[Part, Part]


class Fields(NamedTuple):
    """The value of each of a class' fields, and its slopes along x and y."""

    values: list[Part]
    x: list[Part]
    y: list[Part]


def forms(pairs: Sequence[Pair]) -> list[Floats]:
    """Return the form of each pair, (n, n)."""
    return [_form(a.whole, b.whole) - _form(a.beyond, b.beyond) for a, b in pairs]


def taken(pairs: Sequence[Pair]) -> list[Floats]:
    """Return what rounder corners take of each form, by the logarithm of their radius, (n, n)."""
    return [_form(a.along, b.along) for a, b in pairs]


def fields_of(
    modes: ClassModes, unit: float, counts: tuple[int, int], size_m: tuple[float, float], radius_m: float
) -> Fields:
    """Return a class' fields times `unit`, of a plate of this size with corners of this radius."""
    derivatives = [legendre.derivative(1.0, count) for count in counts]
    rules = [rule(radius_m, size_m, counts) for rule in (corners.pieces, corners.arcs)] if radius_m else []
    tables = [corners.products(rule.on_unit_square(size_m), (1.0, 1.0), counts, modes.places) for rule in rules]
    found = Fields([], [], [])
    for k, ((own_x, own_y), each) in enumerate(zip(modes.places, modes.fields, strict=True)):
        values, (d_x, d_y), n = unit * each, derivatives, len(each)
        wholes = (
            values,
            np.einsum("ij,njk->nik", d_x[_other(own_x), own_x], values, optimize=True),
            values @ d_y[_other(own_y), own_y].T,
        )
        for j, (whole, parts) in enumerate(zip(wholes, found, strict=True)):
            at_points = [values.reshape(n, -1) @ table[k][j].T for table in tables] or 2 * [np.zeros((n, 0))]
            parts.append(Part(whole.reshape(n, -1), *at_points))
    return found


def in_plane(fields: Fields) -> list[Pair]:
    """Return the pairs of the strain energy's six forms in the plane, of the two last fields."""
    (*_, a_x, b_x), (*_, a_y, b_y) = fields.x, fields.y
    return [(a_x, a_x), (b_y, b_y), (a_x, b_y), (a_y, a_y), (b_x, b_x), (a_y, b_x)]


def across(fields: Fields) -> list[Pair]:
    """Return the pairs of the six forms of the strain energy in shear across the plane."""
    (w_x, *_), (w_y, *_), (_, px, py) = fields.x, fields.y, fields.values
    return [(w_x, w_x), (w_x, px), (px, px), (w_y, w_y), (w_y, py), (py, py)]


def _form(a: Floats, b: Floats) -> Floats:
    product = a @ b.T
    return product if a is b else (product + product.T) / 2


def _other(own: slice) -> slice:
    """Return the polynomials of the other parity: a derivative turns even ones into odd ones."""
    return slice(1 - own.start, own.stop, 2)
