"""The field atlas between its nodes: cubic B-splines and their derivatives."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from touchd.localization.atlas import Array, Atlas

Position = tuple[float, float]
"""x and y, mm."""

PER_CELL = 8192
"""The field is looked up on a raster of 8192 points per cell (0.3 um on the shipped grid), so that the spline weights
come from a table. A fit starts from the raster's point, and its last step leads anywhere: nothing is rounded away."""
CELLS = 4
"""Cells whose nodes are cached: those of a few fingers, and the ones they move to."""
# From powers of the fraction of a cell to the four cubic B-splines that are not zero there.
_SPLINES = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64) / 6


class Spline:
    """Evaluates the field and its gradient into the same rows each time.

    Parameters
    ----------
    atlas : Atlas
    into : array of shape (3, size)
        Receives the field, its derivative by x and its derivative by y (per mm): in each row the real parts of all
        channels and bins, then the imaginary parts.
    """

    def __init__(self, atlas: Atlas, into: Array) -> None:
        d = atlas.description
        rows, columns, size = atlas.coefficients.shape
        channels = d.acquisition.channels
        self._nodes = atlas.coefficients.reshape(rows, columns, channels, 2, -1).swapaxes(2, 3)
        (self._x0_mm, self._y0_mm), self._unit_mm = d.origin_mm, d.step_mm / PER_CELL
        self._per_unit = PER_CELL / d.step_mm
        self.low_mm, self.high_mm = known_part_mm(atlas)
        self._limits = (*self.low_mm, *self.high_mm)
        self._of_rows, self._of_columns = _weights(d.step_mm, into.dtype)
        self._into = into
        self._weights = np.zeros(48, into.dtype)
        self._shares = self._weights.reshape(3, 16)
        # Nodes around each cell, contiguous for the product: fingers stay in a cell for some frames.
        self._cells = {(-1, k): np.zeros((16, size), into.dtype) for k in range(CELLS)}

    def inside(self, x_mm: float, y_mm: float) -> Position:
        """Return the nearest position at which the field is known."""
        low_x, low_y, high_x, high_y = self._limits
        # Written so that NaN becomes a corner instead of an index.
        x = x_mm if low_x < x_mm < high_x else high_x if x_mm >= high_x else low_x
        y = y_mm if low_y < y_mm < high_y else high_y if y_mm >= high_y else low_y
        return x, y

    def at(self, x_mm: float, y_mm: float) -> Position:
        """Evaluate the field at the raster point nearest to a position inside, and return that point."""
        across = int((x_mm - self._x0_mm) * self._per_unit + 0.5)
        down = int((y_mm - self._y0_mm) * self._per_unit + 0.5)
        cell = down // PER_CELL, across // PER_CELL
        around = self._cells.get(cell)
        if around is None:
            around = self._fetch(cell)
        np.multiply(self._of_rows[down % PER_CELL], self._of_columns[across % PER_CELL], self._weights)
        self._shares.dot(around, self._into)
        return self._x0_mm + across * self._unit_mm, self._y0_mm + down * self._unit_mm

    def _fetch(self, cell: tuple[int, int]) -> Array:
        """Copy the nodes around a cell, shape (16, size), over those of the cell fetched longest ago."""
        row, column = cell
        nodes = self._nodes[row - 1 : row + 3, column - 1 : column + 3]
        around = self._cells[cell] = self._cells.pop(next(iter(self._cells)))
        around.reshape(nodes.shape)[...] = nodes
        return around


def known_part_mm(atlas: Atlas) -> tuple[Position, Position]:
    """Return the lower and the upper corner of the known field: each place has its four neighbours, on the plate."""
    d = atlas.description
    rows, columns, _ = atlas.coefficients.shape
    (x0_mm, y0_mm), step_mm = d.origin_mm, d.step_mm
    low = max(0.0, x0_mm + step_mm), max(0.0, y0_mm + step_mm)
    last = columns - 2 - 1 / PER_CELL, rows - 2 - 1 / PER_CELL
    return low, (min(d.plate.width_mm, x0_mm + last[0] * step_mm), min(d.plate.height_mm, y0_mm + last[1] * step_mm))


@cache
def _weights(step_mm: float, dtype: np.dtype[Any]) -> tuple[Array, Array]:
    """Return the weights of 16 nodes for the field and its slopes (per mm), by a position's row and by its column.

    Both have the shape (PER_CELL, 48), written out in full: the weights are their product, and the product of two long
    rows is quicker than that of many short ones.
    """
    t = np.arange(PER_CELL) / PER_CELL
    zero, one = np.zeros_like(t), np.ones_like(t)
    values = (np.stack([one, t, t**2, t**3], axis=1) @ _SPLINES).astype(dtype)
    slopes = (np.stack([zero, one, 2 * t, 3 * t**2], axis=1) @ _SPLINES / step_mm).astype(dtype)
    of_rows = np.repeat(np.concatenate([values, values, slopes], axis=1), 4, axis=1)
    of_columns = np.concatenate([values] * 4 + [slopes] * 4 + [values] * 4, axis=1)
    return of_rows, of_columns
