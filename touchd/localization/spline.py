"""The field atlas at one place: cubic B-splines between its nodes, and their derivatives."""

from __future__ import annotations

from functools import cache

import numpy as np

from touchd.localization.atlas import Array, Atlas

Place = tuple[float, float]

PER_CELL = 8192
"""Places are looked up on a raster of so many points a cell (0.3 um on the shipped grid), so that the splines' weights
come of a table. A fit starts from the raster's point, and its last step leads to anywhere: nothing is rounded away."""
CELLS = 4
"""Whose nodes are kept: of a few fingers, and of where they come to next."""
# Powers of the fraction of a cell to the four cubic B-splines that are not zero there.
_SPLINES = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64) / 6


class Lookup:
    """Looks the field up, always into the same rows.

    Parameters
    ----------
    atlas : Atlas
    into : array of shape (3, size)
        Where the field, its derivative by x and that by y (per mm) are put: of each the real parts of all channels and
        bins, then the imaginary parts.
    """

    def __init__(self, atlas: Atlas, into: Array) -> None:
        d = atlas.description
        rows, columns, size = atlas.coefficients.shape
        channels = d.acquisition.channels
        self._nodes = atlas.coefficients.reshape(rows, columns, channels, 2, -1).swapaxes(2, 3)
        (self._x0_mm, self._y0_mm), self._unit_mm = d.origin_mm, d.step_mm / PER_CELL
        self._per_unit = PER_CELL / d.step_mm
        # Every place has its four neighbours, and lies on the plate.
        last = columns - 2, rows - 2
        self.low_mm = tuple(max(0.0, origin + d.step_mm) for origin in d.origin_mm)
        """Where the field begins to be known."""
        self.high_mm = tuple(
            min(size, origin + (count - 1 / PER_CELL) * d.step_mm)
            for size, origin, count in zip((d.plate.width_mm, d.plate.height_mm), d.origin_mm, last, strict=True)
        )
        """Where it ends."""
        self._limits = (*self.low_mm, *self.high_mm)
        self._of_rows, self._of_columns = _weights(d.step_mm)
        self._into = into
        self._weights = np.zeros(48, np.float32)
        self._shares = self._weights.reshape(3, 16)
        # Nodes around cells, together: fingers stay in a cell for some frames, and a product wants the nodes so.
        self._cells = {(-1, k): np.zeros((16, size), np.float32) for k in range(CELLS)}

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
        cell = down // PER_CELL, across // PER_CELL
        around = self._cells.get(cell)
        if around is None:
            around = self._fetch(cell)
        np.multiply(self._of_rows[down % PER_CELL], self._of_columns[across % PER_CELL], self._weights)
        self._shares.dot(around, self._into)
        return self._x0_mm + across * self._unit_mm, self._y0_mm + down * self._unit_mm

    def _fetch(self, cell: tuple[int, int]) -> Array:
        """Put the nodes around a cell where those of the cell fetched longest ago were, shape (16, size)."""
        row, column = cell
        nodes = self._nodes[row - 1 : row + 3, column - 1 : column + 3]
        around = self._cells[cell] = self._cells.pop(next(iter(self._cells)))
        around.reshape(nodes.shape)[...] = nodes
        return around


@cache
def _weights(step_mm: float) -> tuple[Array, Array]:
    """Return what the field, its slope by x and that by y (per mm) take of 16 nodes, by a place's row and its column.

    Both are of shape (PER_CELL, 48), written out in full: what is taken is their product, and one of two long rows is
    quicker than one of many short ones.
    """
    t = np.arange(PER_CELL) / PER_CELL
    zero, one = np.zeros_like(t), np.ones_like(t)
    values = (np.stack([one, t, t**2, t**3], axis=1) @ _SPLINES).astype(np.float32)
    slopes = (np.stack([zero, one, 2 * t, 3 * t**2], axis=1) @ _SPLINES / step_mm).astype(np.float32)
    of_rows = np.repeat(np.concatenate([values, values, slopes], axis=1), 4, axis=1)
    of_columns = np.concatenate([values] * 4 + [slopes] * 4 + [values] * 4, axis=1)
    return of_rows, of_columns
