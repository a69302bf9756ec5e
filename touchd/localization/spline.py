"""The field atlas between its nodes, of points and of contacts with a shape: cubic B-splines and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Array, Atlas
from touchd.localization.loading import Loading
from touchd.localization.spline_weights import PER_CELL, SLOPES, spline_weights

Position = tuple[float, float]
"""x and y, mm."""
Shape = tuple[complex, ...]
"""Slope along the band, and the second-order amplitudes (mm^2) along xx, yy and xy, all over the amplitude."""

CONTACT_PER_CELL = 256
"""`PER_CELL` of contacts with a shape, which need more derivatives: 10 um. Small tables stay in the caches."""
CELLS = 4
"""Cells whose nodes are cached: those of a few fingers, and the ones they move to."""
SHAPES = 8
"""Shapes whose tables are kept: those of the fingers that are followed."""
ORDERS = ((0, 0), (2, 0), (0, 2), (1, 1), (1, 0), (0, 1), (3, 0), (0, 3), (2, 1), (1, 2))
"""Derivatives along x and y, in the order of `derivatives`: what a contact's field holds, then what its slopes hold."""
U, XX, YY, XY, X, Y, XXX, YYY, XXY, XYY = range(10)
TERMS = ((U, XX, YY, XY), (X, XXX, XYY, XXY), (Y, XXY, YYY, XYY))
"""What the field, its slope by x and its slope by y hold: first of u, then of its second derivatives."""


class Raster:
    """Rounds positions to points of a raster, and keeps contiguous copies of the nodes around the cells in use.

    Parameters
    ----------
    atlas : Atlas
    per_cell : int
        Points of the raster per cell, along each axis.
    orders : tuple of pairs
        Of the derivatives, along x and y.
    """

    def __init__(self, atlas: Atlas, per_cell: int, orders: tuple[tuple[int, int], ...]) -> None:
        d, dtype = atlas.description, atlas.coefficients.dtype
        self._of_rows, self._of_columns = spline_weights(d.step_mm, dtype, orders, per_cell)
        self._weights = np.zeros(16 * len(orders), dtype)
        self._by_order = self._weights.reshape(-1, 16)
        # In each node the real parts of all channels, then the imaginary parts: fetched so, not held so a second time.
        parts = *atlas.coefficients.shape[:2], d.acquisition.channels, 2, len(d.bins)
        self._nodes = atlas.coefficients.reshape(parts).swapaxes(2, 3)
        self._of_cell = 4, 4, *self._nodes.shape[2:]
        self._grid = per_cell, per_cell / d.step_mm, d.step_mm / per_cell, *d.origin_mm
        self.low_mm, self.high_mm = known_part_mm(atlas)
        self._limits = (*self.low_mm, *self.high_mm)
        self.loading = Loading(atlas) if atlas.yields is not None else None
        """Of an atlas that knows how the plate yields under a contact."""
        self._cells = {(-1, k): np.zeros((16, atlas.size), dtype) for k in range(CELLS)}

    def inside(self, x_mm: float, y_mm: float) -> Position:
        """Return the nearest position at which the field is known."""
        low_x, low_y, high_x, high_y = self._limits
        if low_x < x_mm < high_x and low_y < y_mm < high_y:
            return x_mm, y_mm
        # Written so that NaN becomes a corner instead of an index.
        x = x_mm if low_x < x_mm < high_x else high_x if x_mm >= high_x else low_x
        y = y_mm if low_y < y_mm < high_y else high_y if y_mm >= high_y else low_y
        return x, y

    def moved(
        self, positions_mm: Sequence[Position], moves_mm: Sequence[float], most_mm: float
    ) -> tuple[float, list[Position]]:
        """Return the longest of moves (x and y in turn), mm, and where they lead, none farther than `most_mm`."""
        longest_mm, moved, each = 0.0, [], iter(moves_mm)
        for x, y in positions_mm:
            step_x, step_y = next(each), next(each)
            length = (step_x * step_x + step_y * step_y) ** 0.5
            shorter = most_mm / length if length > most_mm else 1.0
            moved.append(self.inside(x + shorter * step_x, y + shorter * step_y))
            longest_mm = max(longest_mm, length)
        return longest_mm, moved

    def _weigh(self, x_mm: float, y_mm: float) -> tuple[Position, Array]:
        """Set the nodes' weights in each derivative for the raster point nearest to a position inside.

        Return that point, and the nodes around it, shape (16, size): real parts, then imaginary parts.
        """
        per_cell, per_unit, unit_mm, x0_mm, y0_mm = self._grid
        across, down = int((x_mm - x0_mm) * per_unit + 0.5), int((y_mm - y0_mm) * per_unit + 0.5)
        cell = down // per_cell, across // per_cell
        around = self._cells.get(cell)
        if around is None:
            around = self._fetch(cell)
        np.multiply(self._of_rows[down % per_cell], self._of_columns[across % per_cell], self._weights)
        return (x0_mm + across * unit_mm, y0_mm + down * unit_mm), around

    def _fetch(self, cell: tuple[int, int]) -> Array:
        """Copy the nodes around a cell over those of the cell fetched longest ago."""
        row, column = cell
        around = self._cells[cell] = self._cells.pop(next(iter(self._cells)))
        around.reshape(self._of_cell)[...] = self._nodes[row - 1 : row + 3, column - 1 : column + 3]
        return around


class Spline(Raster):
    """Evaluates the field and its gradient into the same rows each time.

    Parameters
    ----------
    atlas : Atlas
    into : array of shape (3, size)
        Receives the field, its derivative by x and its derivative by y (per mm): in each row the real parts of all
        channels and bins, then the imaginary parts.
    """

    def __init__(self, atlas: Atlas, into: Array) -> None:
        super().__init__(atlas, PER_CELL, SLOPES)
        self._into = into

    def at(self, x_mm: float, y_mm: float, size: float = 1.0) -> Position:
        """Evaluate the field at the raster point nearest to a position inside, and return that point.

        `size` is the modulus of the touch's amplitude, over which the field is.
        """
        position, around = self._weigh(x_mm, y_mm)
        self._by_order.dot(around, self._into)
        if self.loading:
            self.loading.weigh(*position, size, self._into)
        return position


class ContactField(Raster):
    """Evaluates the field of contacts with a size and a shape.

    About its middle the field of such a contact is z u + s b u + a u_xx + b u_yy + c u_xy, with b from -1 to 1 along
    the band. Of a contact whose shape (s, a, b, c over z) is known this is one field, which is looked up as quickly as
    u: the shape mixes the splines' weights, not the rows.

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

    def derivatives(self, x_mm: float, y_mm: float, into: Array, size: float = 1.0) -> Position:
        """Evaluate u and its derivatives at the raster point nearest to a position inside, and return that point.

        `into`, shape (2, 10, half an atlas' size), receives real and imaginary parts of `ORDERS`, per mm.
        """
        position, around = self._weigh(x_mm, y_mm)
        np.matmul(self._by_order, around.reshape(16, 2, -1).swapaxes(0, 1), into)
        if self.loading:
            self.loading.weigh(*position, size, into.swapaxes(0, 1))
        return position

    def of_shape(self, x_mm: float, y_mm: float, shape: Shape, size: float = 1.0) -> Position:
        """Evaluate the field of a contact with a shape, as `Spline.at` does that of a point."""
        mixture = self._mixtures.get(shape)
        if mixture is None:
            mixture = self._mix(shape)
        position, around = self._weigh(x_mm, y_mm)
        self._of_nodes.dot(mixture, self._mixed)
        self._shares.dot(around.reshape(32, -1), self._sums)
        np.multiply(self._along, self._bands, self._along)
        np.add(self._alone, self._along, self._halves)
        if self.loading:
            self.loading.weigh(*position, size, self._halves.reshape(3, -1))
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


def known_part_mm(atlas: Atlas) -> tuple[Position, Position]:
    """Return the lower and the upper corner of the known field: each place has its four neighbours, on the plate."""
    d = atlas.description
    rows, columns, _ = atlas.coefficients.shape
    (x0_mm, y0_mm), step_mm = d.origin_mm, d.step_mm
    low = max(0.0, x0_mm + step_mm), max(0.0, y0_mm + step_mm)
    last = columns - 2 - 1 / CONTACT_PER_CELL, rows - 2 - 1 / CONTACT_PER_CELL
    return low, (min(d.plate.width_mm, x0_mm + last[0] * step_mm), min(d.plate.height_mm, y0_mm + last[1] * step_mm))
