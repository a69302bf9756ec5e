"""What weighs on a plate changes its own field: the plate yields under it, most of all where it resonates.

A contact of amplitude A takes -A L / (1 + A L Y) of the wave at it, L the load of the reference touch, Y the plate's
receptance there. So its field is that of the reference, over 1 + (A - 1) s, with the reference's share
s = L Y / (1 + L Y). On 2 mm of glass in steady state that share is 0.13, up to 1.5 at resonances: without it the
reference's field leaves 12 % of a gloved touch, with it 0.2 % (twin, 96 kHz).
"""

from __future__ import annotations

import numpy as np

from touchd.localization.atlas import Array, Atlas
from touchd.localization.spline_weights import PER_CELL, SLOPES, spline_weights

MOST_SIZE = 4.0
"""Amplitudes beyond, of palms, change the field no more."""


class Loading:
    """Turns the field of the reference touch into that of a lighter or heavier one.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        assert atlas.yields is not None
        d, dtype = atlas.description, atlas.coefficients.dtype
        self._of_rows, self._of_columns = spline_weights(d.step_mm, dtype, SLOPES, PER_CELL)
        self._shape = d.acquisition.channels, len(d.bins)
        # Real and imaginary parts in turn, as complex numbers lie: a product of real numbers is quicker.
        self._nodes = np.ascontiguousarray(atlas.yields.reshape(*atlas.yields.shape[:2], 2, -1).swapaxes(2, 3))
        self._complex = np.result_type(dtype, np.complex64)
        self._grid = PER_CELL / d.step_mm, *d.origin_mm

    def weigh(self, x_mm: float, y_mm: float, size: float, rows: Array) -> None:
        """Turn rows (k, 2 * channels * bins) at a position inside into those of a touch of amplitude `size`.

        They are a field, and its derivatives by x and y where there are three of them. Of more derivatives, which only
        tell a contact's shape, that of the share is left out.
        """
        more = min(size, MOST_SIZE) - 1
        if not more:
            return
        per_unit, x0_mm, y0_mm = self._grid
        across, down = int((x_mm - x0_mm) * per_unit + 0.5), int((y_mm - y0_mm) * per_unit + 0.5)
        row, column = down // PER_CELL, across // PER_CELL
        weights = (self._of_rows[down % PER_CELL] * self._of_columns[across % PER_CELL]).reshape(3, 16)
        has_slopes = len(rows) == len(SLOPES)
        around = self._nodes[row - 1 : row + 3, column - 1 : column + 3].reshape(16, -1)
        share = (weights if has_slopes else weights[:1]).dot(around).view(self._complex)  # and its slopes
        factor = 1 / (1 + more * share[0])
        parts = rows.reshape(len(rows), 2, *self._shape)
        field = np.empty((len(rows), *self._shape), share.dtype)
        field.real, field.imag = parts[:, 0], parts[:, 1]
        field *= factor
        if has_slopes:
            field[1:] -= (more * factor * share[1:])[:, None] * field[0]
        parts[:, 0], parts[:, 1] = field.real, field.imag
