"""The grid of an atlas' splines, and their coefficients from samples on the plate.

They are fitted by least squares: to samples at each node, on the edges, and at half steps in the outermost cells, where
the nodes beyond the edge have no sample of their own.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np

from touchd.calibration.reduced_plate import Complex, Floats
from touchd.localization.atlas import Array
from touchd.training.field.place import real_nodes

_DENSE_CELLS = 2
Solved = TypeVar("Solved", Floats, Complex)


class Grid(NamedTuple):
    """One axis of the splines."""

    nodes_mm: Floats
    samples_mm: Floats
    """Where the field is computed, all on the plate."""
    solve: Floats
    """Maps samples to coefficients, shape (nodes, samples)."""


def grid_of(length_mm: float, step_mm: float) -> Grid:
    """Return the nodes and samples along a side, from one node beyond the plate to two beyond."""
    cells = int(np.ceil(length_mm / step_mm))
    first_mm = (length_mm - cells * step_mm) / 2 - step_mm
    nodes: Floats = first_mm + step_mm * np.arange(cells + 4, dtype=np.float64)
    outer = (np.arange(_DENSE_CELLS) + 0.5) * step_mm
    samples = np.unique(np.clip(np.concatenate([nodes, nodes[1] + outer, nodes[cells + 1] - outer]), 0.0, length_mm))
    solve = np.linalg.pinv(spline_values(samples, nodes, step_mm), rcond=1e-6)
    return Grid(*(np.asarray(array, np.float64) for array in (nodes, samples, solve)))


def spline_values(at_mm: Floats, nodes_mm: Floats, step_mm: float) -> Floats:
    """Return each node's cubic B-spline at places (...), shape (..., nodes)."""
    apart = np.abs(at_mm[..., None] - nodes_mm) / step_mm
    near = 2 / 3 - apart**2 + apart**3 / 2
    return np.asarray(np.where(apart < 1, near, np.maximum(2 - apart, 0.0) ** 3 / 6))


def solved(values: Solved, x: Grid, y: Grid) -> Solved:
    """Return the coefficients of splines through values at all samples of a grid, row by row: (samples, ...)."""
    rows = values.reshape(len(y.samples_mm), len(x.samples_mm), -1)
    nodes = np.tensordot(y.solve, np.tensordot(x.solve, rows, (1, 1)), (1, 1))
    found: Solved = nodes.reshape(*nodes.shape[:2], *values.shape[1:])
    return found


def coefficients_of(values: Complex, x: Grid, y: Grid) -> Array:
    """Return an atlas' coefficients from the field at all samples of its grid, row by row: (samples, R, bins)."""
    return real_nodes(solved(values, x, y))
