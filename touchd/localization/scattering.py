"""Several contacts in steady state: each sends on what the others send to it.

Alone, contact i takes x_i = L_i e_i / (1 + L_i G_ii) of the wave e_i at it: that is what its own field holds. Beside
others it takes what solves

    x_i = L_i (e_i - sum over j of G_ij x_j)

with the plate's receptance G between the contacts, and the load L_i: the reference touch's times the amplitude. The
difference reaches the receivers as one more wave, whose strength follows from the contacts' places and amplitudes: it
is taken out of the frame, and what is left is the sum of their own fields. It has 11 % of the energy of two fingertips
of 70 mm^2 on 2 mm of glass at 96 kHz, and 1.5 % on 5 mm at 192 kHz (twin).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Atlas
from touchd.localization.fit import Bins
from touchd.localization.loading import MOST_SIZE
from touchd.localization.plate_modes import Array
from touchd.localization.spline import Position
from touchd.localization.spline_weights import SPLINES

Floats = NDArray[np.floating]


class Scattering:
    """Computes what contacts add to each other's fields.

    Parameters
    ----------
    atlas : Atlas
        One that holds the plate's modes.
    """

    def __init__(self, atlas: Atlas) -> None:
        assert atlas.modes is not None
        modes = atlas.modes
        self._shapes, self._grid_mm, self._to_bins = modes.shapes, modes.grid_mm, modes.to_bins
        self._discs = np.ascontiguousarray(modes.discs.T)  # (1 + R, n)
        self._loads, self._heard = modes.loads, modes.heard
        self._real = not np.iscomplexobj(modes.shapes)
        # Of real shapes a product of real numbers does, with both parts side by side.
        self._receptance = modes.receptance.view(modes.to_bins.dtype) if self._real else modes.receptance

    def take_out(
        self, bins: Bins, positions_mm: Sequence[Position], amplitudes: Sequence[complex]
    ) -> tuple[Bins, Floats]:
        """Return a frame's bins without what contacts add to each other's fields, and that; `amplitudes` as of `of`."""
        added = self.of(positions_mm, amplitudes)
        if bins.mask is not None:
            added = added * bins.mask
        return bins.without(added), added

    def of(self, positions_mm: Sequence[Position], amplitudes: Sequence[complex]) -> Floats:
        """Return what contacts add to each other's fields, as the vector of bins has it, (channels * 2 * bins,).

        `amplitudes` are those of points; of larger ones than a thumb's, the phase alone counts.
        """
        z = np.array([one / max(abs(one) / MOST_SIZE, 1.0) for one in amplitudes], self._loads.dtype)
        under = np.stack([self._under(*position) for position in positions_mm])  # (c, n)
        count, n = under.shape
        one, other = _pairs(count)
        rows = np.concatenate([under[one] * under[other], (under[:, None] * self._discs).reshape(-1, n)])
        answers = (rows @ self._receptance).view(self._loads.dtype)  # (.., F)
        between, to_discs = answers[: len(one)], answers[len(one) :].reshape(count, len(self._discs), -1)
        loads = z[:, None] * self._loads
        taken = loads * to_discs[:, 0]
        own = 1 + loads * between[:count]
        if count == 2:
            back = loads[::-1] * between[2] ** 2 * loads / own[::-1]
            more = loads * between[2] * (taken / own)[::-1]
            together = (taken - more) / (own - back)
        else:
            system = np.empty((between.shape[1], count, count), between.dtype)
            system[:, one, other] = system[:, other, one] = between.T
            system = loads.T[:, :, None] * system
            system.reshape(len(system), -1)[:, :: count + 1] = own.T
            together = np.linalg.solve(system, taken.T[:, :, None])[:, :, 0].T
        sent = ((taken / own - together)[:, None] * to_discs[:, 1:]).sum(axis=0) * self._heard
        return np.asarray(np.concatenate([sent.real, sent.imag], axis=1).dot(self._to_bins).reshape(-1))

    def _under(self, x_mm: float, y_mm: float) -> Array:
        """Return each mode's deflection under the reference touch, shape (n,)."""
        step_mm, x0_mm, y0_mm = self._grid_mm
        rows, columns, n = self._shapes.shape
        column, of_columns = _weights((x_mm - x0_mm) / step_mm, columns)
        row, of_rows = _weights((y_mm - y0_mm) / step_mm, rows)
        around = self._shapes[row : row + 4, column : column + 4].reshape(16, n)
        return np.asarray(np.outer(of_rows, of_columns).reshape(-1).astype(self._to_bins.dtype).dot(around))


@cache
def _pairs(count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return all pairs of contacts, those of each with itself first."""
    one, other = np.triu_indices(count)
    first = np.argsort(one != other, kind="stable")
    return one[first], other[first]


def _weights(at: float, count: int) -> tuple[int, NDArray[np.float64]]:
    """Return the first of the four nodes around a place, counted in nodes, and their cubic B-splines' values there."""
    cell = min(max(int(at), 1), count - 3)
    t = at - cell
    return cell - 1, np.array([1.0, t, t * t, t**3]) @ SPLINES
