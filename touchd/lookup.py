"""The field atlas at one place: cubic B-splines between its nodes, and their derivatives."""

from __future__ import annotations

import numpy as np

from touchd.atlas import Array, Atlas

Place = tuple[float, float]

PER_CELL = 16384
"""Places are looked up on a raster of so many points a cell (0.15 um on the shipped grid), so that the splines' weights
come of a table. A fit starts from the raster's point, and its last step leads to anywhere: nothing is rounded away."""
# Powers of the fraction of a cell to the four cubic B-splines that are not zero there.
_SPLINES = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64) / 6


class Lookup:
    """Looks the field up, always into the same rows.

    Parameters
    ----------
    atlas : Atlas
    into : array of shape (3, size)
        Where the field, its derivative by x and that by y (per mm) are put.
    """

    def __init__(self, atlas: Atlas, into: Array) -> None:
        d = atlas.description
        nodes = atlas.coefficients
        rows, columns, self._size = nodes.shape
        self._lines = nodes.reshape(rows, -1)
        (self._x0_mm, self._y0_mm), self._unit_mm = d.origin_mm, d.step_mm / PER_CELL
        self._per_unit = PER_CELL / d.step_mm
        # Every place has its four neighbours, and lies on the plate.
        last = columns - 2, rows - 2
        self.low_mm = tuple(max(0.0, origin + d.step_mm) for origin in d.origin_mm)
        """Where the field begins to be known."""
        self.high_mm = tuple(
            min(size, origin + (count - 1e-4) * d.step_mm)
            for size, origin, count in zip((d.plate.width_mm, d.plate.height_mm), d.origin_mm, last, strict=True)
        )
        """Where it ends."""
        self._limits = (*self.low_mm, *self.high_mm)
        self._weights = _weights(d.step_mm)
        self._into_x, self._into_y = into[:2], into[2]
        self._along_y = np.zeros((2, 4 * self._size), np.float32)
        self._value_line, self._slope_line = self._along_y.reshape(2, 4, self._size)

    def inside(self, x_mm: float, y_mm: float) -> Place:
        """Return the nearest place at which the field is known."""
        low_x, low_y, high_x, high_y = self._limits
        # Written so that what is no number becomes the corner instead of an index.
        x = x_mm if low_x < x_mm < high_x else high_x if x_mm >= high_x else low_x
        y = y_mm if low_y < y_mm < high_y else high_y if y_mm >= high_y else low_y
        return x, y

    def at(self, x_mm: float, y_mm: float) -> Place:
        """Look up the point of the raster nearest to a place inside, and return it."""
        across = int((x_mm - self._x0_mm) * self._per_unit + 0.5)
        down = int((y_mm - self._y0_mm) * self._per_unit + 0.5)
        of_x, of_y = self._weights[across % PER_CELL], self._weights[down % PER_CELL]
        row, first = down // PER_CELL, (across // PER_CELL - 1) * self._size
        # Four neighbouring nodes of a row lie one after the other: the rows are summed first, without the copy that
        # `dot` would make.
        np.matmul(of_y, self._lines[row - 1 : row + 3, first : first + 4 * self._size], self._along_y)
        of_x.dot(self._value_line, self._into_x)
        of_x[0].dot(self._slope_line, self._into_y)
        return self._x0_mm + across * self._unit_mm, self._y0_mm + down * self._unit_mm


def _weights(step_mm: float) -> Array:
    """Return the weights of four nodes for the value and for the slope per mm, shape (PER_CELL, 2, 4)."""
    t = np.arange(PER_CELL) / PER_CELL
    zero, one = np.zeros_like(t), np.ones_like(t)
    powers = np.array([[one, t, t**2, t**3], [zero, one, 2 * t, 3 * t**2]]).transpose(2, 0, 1)
    return np.asarray(powers @ _SPLINES / np.array([1.0, step_mm])[:, None], np.float32)
