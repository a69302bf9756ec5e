"""The field of a contact with a size and a shape, between the atlas' nodes.

About its middle the field of such a contact is z u + s b u + a u_xx + b u_yy + c u_xy, with b from -1 to 1 along the
band. Of a contact whose shape (s, a, b, c over z) is known this is one field, which is looked up as quickly as u: the
shape mixes the splines' weights, not the rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Array, Atlas
from touchd.localization.spline import CONTACT_PER_CELL, Position, Raster

Shape = tuple[complex, ...]
"""Slope along the band, and the second-order amplitudes (mm^2) along xx, yy and xy, all over the amplitude."""

SHAPES = 8
"""Shapes whose tables are kept: those of the fingers that are followed."""
ORDERS = ((0, 0), (2, 0), (0, 2), (1, 1), (1, 0), (0, 1), (3, 0), (0, 3), (2, 1), (1, 2))
"""Derivatives along x and y, in the order of `derivatives`: what a contact's field holds, then what its slopes hold."""
U, XX, YY, XY, X, Y, XXX, YYY, XXY, XYY = range(10)
TERMS = ((U, XX, YY, XY), (X, XXX, XYY, XXY), (Y, XXY, YYY, XYY))
"""What the field, its slope by x and its slope by y hold: first of u, then of its second derivatives."""


class ContactField(Raster):
    """Evaluates the field of contacts.

    Parameters
    ----------
    atlas : Atlas
    into : array of shape (3, size)
        Receives the field and its derivatives, as in `Spline`.
    """

    def __init__(self, atlas: Atlas, into: Array) -> None:
        dtype, half = into.dtype, atlas.size // 2
        self.band: Array = place_in_band(atlas).astype(dtype)
        super().__init__(atlas, CONTACT_PER_CELL, ORDERS)
        self._of_nodes = self._by_order.T
        self._parts = np.zeros(9, dtype)
        self._parts[0] = 1
        self._terms = _terms(dtype)
        self._mixtures: dict[Shape, Array] = {(complex(k),): np.zeros((10, 24), dtype) for k in range(SHAPES)}
        self._mixed = np.zeros((16, 24), dtype)
        self._shares, self._halves = self._mixed.reshape(32, 12).T, into.reshape(6, half)
        self._sums = np.zeros((12, half), dtype)
        self._alone, self._along = self._sums[:6], self._sums[6:]
        self._bands = np.tile(self.band, (6, 1))  # written out: a product of like shapes is quicker

    def derivatives(self, x_mm: float, y_mm: float, into: Array) -> Position:
        """Evaluate u and its derivatives at the raster point nearest to a position inside, and return that point.

        `into`, shape (2, 10, size / 2), receives real and imaginary parts of `ORDERS`, per mm.
        """
        position, around = self._weigh(x_mm, y_mm)
        np.matmul(self._by_order, around.reshape(16, 2, -1).swapaxes(0, 1), into)
        return position

    def of_shape(self, x_mm: float, y_mm: float, shape: Shape) -> Position:
        """Evaluate the field of a contact of amplitude 1, as `Spline.at` does that of a point."""
        mixture = self._mixtures.get(shape)
        if mixture is None:
            mixture = self._mix(shape)
        position, around = self._weigh(x_mm, y_mm)
        self._of_nodes.dot(mixture, self._mixed)
        self._shares.dot(around.reshape(32, -1), self._sums)
        np.multiply(self._along, self._bands, self._along)
        np.add(self._alone, self._along, self._halves)
        return position

    def _mix(self, shape: Shape) -> Array:
        """Return how a shape mixes derivatives; a followed finger keeps its shape, and so the table."""
        mixture = self._mixtures[shape] = self._mixtures.pop(next(iter(self._mixtures)))
        parts = self._parts
        for k, part in enumerate(shape):
            parts[2 * k + 1], parts[2 * k + 2] = part.real, part.imag
        parts.dot(self._terms, mixture.reshape(-1))
        return mixture


def place_in_band(atlas: Atlas) -> NDArray[np.float64]:
    """Return the place of each channel's bins in the band, -1 to 1, shape (size / 2,)."""
    d, bins = atlas.description, np.array(atlas.description.bins, float)
    middle, reach = (bins[0] + bins[-1]) / 2, max((bins[-1] - bins[0]) / 2, 1.0)
    return np.tile((bins - middle) / reach, d.acquisition.channels)


def _terms(dtype: np.dtype[np.floating]) -> Array:
    """Return how a shape's real and imaginary parts mix derivatives to fields, shape (9, 240).

    Columns: derivative (10), the nodes' parts (2), alone and along the band (2), field and slopes (3), their parts (2).
    """
    terms = np.zeros((9, 2, 3, 2, 2, 10), dtype)
    for field, (own, *second) in enumerate(TERMS):
        # 1, the slope along the band, and the second derivatives.
        for real, imaginary, along, order in (
            (0, None, 0, own), (1, 2, 1, own), *((3 + 2 * k, 4 + 2 * k, 0, order) for k, order in enumerate(second))
        ):  # fmt: skip
            terms[real, along, field, (0, 1), (0, 1), order] = 1
            if imaginary is not None:
                terms[imaginary, along, field, 0, 1, order] = -1
                terms[imaginary, along, field, 1, 0, order] = 1
    return terms.transpose(0, 5, 4, 1, 2, 3).reshape(9, -1)
