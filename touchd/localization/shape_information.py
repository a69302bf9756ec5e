"""What the field at a place tells of a contact's shape, and how far a shape that is left out moves the position.

Both are tables over the atlas' nodes, for a contact of amplitude 1.
"""

from __future__ import annotations

import cmath
from weakref import WeakKeyDictionary

import numpy as np

from touchd.localization.atlas import Atlas
from touchd.localization.contact_field import place_in_band
from touchd.localization.spline import Position

PHASE_RAD = 0.4
"""Of a round face's second-order amplitudes over its amplitude, alike for all sizes."""
_STENCILS = np.array([[1, 4, 1], [-3, 0, 3], [6, -12, 6]]) / 6
"""Value and first two derivatives of a cubic B-spline at a node."""
_DERIVATIVES = ((1, 0), (0, 1), (0, 0), (2, 0), (0, 2), (1, 1))
"""Orders along x and y of u_x, u_y, u, u_xx, u_yy and u_xy."""
_TURN = cmath.rect(1.0, PHASE_RAD)
Table = list[list[float]]
Tables = tuple[Table, Table, Table]
_known: WeakKeyDictionary[Atlas, Tables] = WeakKeyDictionary()


class ShapeInformation:
    """Looks up the tables of an atlas; the quarter of a second that they take is spent once for each atlas.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        (self._x0_mm, self._y0_mm), self._step_mm = atlas.description.origin_mm, atlas.description.step_mm
        rows, columns, _ = atlas.coefficients.shape
        self._last_x, self._last_y = columns - 1.001, rows - 1.001
        if (tables := _known.get(atlas)) is None:
            tables = _known[atlas] = _tables(atlas)
        self._mean, self._oval, self._bias2 = tables

    def variances(self, position_mm: Position) -> tuple[float, float]:
        """Return the variances of mean and oval moment over z by noise of unit variance, mm^4 / counts^2."""
        return self._between(self._mean, position_mm), self._between(self._oval, position_mm)

    def bias2(self, position_mm: Position) -> float:
        """Return the mean square per axis, mm^2, by which a point's position errs for 1 mm^2 of mean moment."""
        return self._between(self._bias2, position_mm)

    def _between(self, table: Table, position_mm: Position) -> float:
        x_mm, y_mm = position_mm
        x = min(max((x_mm - self._x0_mm) / self._step_mm, 0.0), self._last_x)
        y = min(max((y_mm - self._y0_mm) / self._step_mm, 0.0), self._last_y)
        column, row = int(x), int(y)
        above, below = table[row], table[row + 1]
        x -= column
        y -= row
        upper = above[column] + x * (above[column + 1] - above[column])
        return upper + y * (below[column] + x * (below[column + 1] - below[column]) - upper)


def _tables(atlas: Atlas) -> Tables:
    """Return the variances of both moments and the bias at every node.

    The first two invert the Fisher information of x, y and the five amplitudes of one contact. Fingers nearby share
    their information; that is left out, as what the fit of several leaves is larger. The bias is that of omitted
    variables: where a fit of x, y and u alone moves to explain u_xx + u_yy.
    """
    d, nodes = atlas.description, atlas.coefficients
    channels, bins = d.acquisition.channels, len(d.bins)
    stencils = _STENCILS.astype(nodes.dtype)
    band = place_in_band(atlas).astype(nodes.dtype)
    # Unknowns: x, y, the parts of u, of u along the band, of a_xx, of a_yy and of a_xy.
    wanted = np.zeros((3, 12))
    wanted[0, -6:-2] = np.tile([_TURN.real / 2, _TURN.imag / 2], 2)
    wanted[1, [-6, -4]], wanted[2, -2] = (0.5, -0.5), 0.5
    found: Tables = ([], [], [])
    for row in range(len(nodes)):
        above = np.clip(np.arange(row - 1, row + 2), 0, len(nodes) - 1)
        along_y = np.tensordot(stencils, nodes[above], 1)  # (orders, columns, size)
        beside = np.clip(np.arange(nodes.shape[1])[:, None] + (-1, 0, 1), 0, nodes.shape[1] - 1)
        fields = np.stack(
            [np.einsum("k,nks->ns", stencils[i], along_y[j][beside]) / d.step_mm ** (i + j) for i, j in _DERIVATIVES],
            axis=1,
        )
        parts = fields.reshape(len(fields), len(_DERIVATIVES), channels, 2, bins)
        x, y, u, *second = (
            (parts[..., 0, :] + np.complex64(1j) * parts[..., 1, :]).reshape(*fields.shape[:2], -1).swapaxes(0, 1)
        )
        columns = np.stack([x, y, *(turned * one for one in (u, u * band, *second) for turned in (1, 1j))], axis=1)
        information = (columns.conj() @ columns.swapaxes(1, 2)).real.astype(np.float64)
        # A field of zeros, as of a plate without channels, tells nothing.
        empty = ~(np.linalg.matrix_rank(information) == information.shape[-1])
        information[empty] = np.eye(information.shape[-1])
        spread = np.einsum("ki,nij,kj->nk", wanted, np.linalg.inv(information), wanted)
        spread[empty] = np.inf
        bias_mm = np.linalg.solve(information[:, :4, :4], 2 * information[:, :4] @ wanted[0, :, None])[:, :2, 0]
        for table, values in zip(
            found, (spread[:, 0], spread[:, 1:].mean(axis=1), np.square(bias_mm).mean(axis=1)), strict=True
        ):
            table.append(values.tolist())
    return found
