"""Weights of an atlas' nodes in the field between them, and in its derivatives: tables of cubic B-splines."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from touchd.localization.atlas import Array

PER_CELL = 4096
"""The field is looked up on a raster of 4096 points per cell (0.6 um on the shipped grid), so that the spline weights
come from a table. A fit starts from the raster's point, and its last step leads anywhere: nothing is rounded away."""
SLOPES = ((0, 0), (1, 0), (0, 1))
"""Orders along x and y of the field, and of its slopes."""
# From powers of the fraction of a cell to the four cubic B-splines that are not zero there.
SPLINES = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64) / 6


@cache
def spline_weights(
    step_mm: float, dtype: np.dtype[Any], orders: tuple[tuple[int, int], ...], per_cell: int
) -> tuple[list[Array], list[Array]]:
    """Return the weights of 16 nodes for derivatives of the field, by a position's row and by its column.

    Both have `per_cell` rows of 16 * derivatives, written out in full: the weights are their product, and the product
    of two long rows is quicker than that of many short ones. `orders` are those along x and y, per mm.
    """
    t = np.arange(per_cell) / per_cell
    zero, one = np.zeros_like(t), np.ones_like(t)
    powers = ([one, t, t**2, t**3], [zero, one, 2 * t, 3 * t**2], [zero, zero, 2 * one, 6 * t], [zero] * 3 + [6 * one])
    of_order = [
        (np.stack(power, axis=1) @ SPLINES / step_mm**order).astype(dtype) for order, power in enumerate(powers)
    ]
    of_rows = np.concatenate([np.repeat(of_order[along_y], 4, axis=1) for _, along_y in orders], axis=1)
    of_columns = np.concatenate([np.tile(of_order[along_x], 4) for along_x, _ in orders], axis=1)
    return list(of_rows), list(of_columns)
