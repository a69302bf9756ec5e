"""From rough positions to precise ones: Gauss-Newton on the field atlas, the touches' strengths eliminated.

The bins d of a frame with c fingers are modelled as sum z_k u(x_k, y_k), the z_k complex and unknown. For
given places the best z follow by linear least squares; what is left over is made smaller by moving the
places (variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10:413, 1973; in the form of Kaufman,
BIT 15:49, 1975, which leaves out what the strengths' own change adds to the second order).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.atlas import Array, Atlas

Place = tuple[float, float]

LONGEST_STEP_MM = 3.0
"""About a tenth of the field's wavelength: a longer step would leave the valley that it starts in."""
STILL_MM = 0.2
"""After a shorter step the next one, of second order, would be less than 0.01 mm in 95 of 100 cases (twin)."""
_DAMPING = 1e-3
# Powers of the fraction of a cell to the four cubic B-splines that are not zero there.
_SPLINES = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float32) / 6


class Fit(NamedTuple):
    """Fingers that explain a frame."""

    places_mm: list[Place]
    strengths: list[complex]
    energies: list[float]
    """|z u|^2 of each finger, ADC counts squared."""
    information: NDArray[np.float64]
    """Re(J^H J) with the strengths projected out, for x and y of each finger in turn, shape (2c, 2c): its inverse,
    times the noise variance of a feature, is the covariance of the places in mm^2. Valid until the next fit."""
    left: float
    """Energy that the fingers do not explain, ADC counts squared."""


class Refiner:
    """Fits fingers to one frame at a time.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        d = atlas.description
        self._channels, self._bins = d.acquisition.channels, len(d.bins)
        self._nodes = atlas.coefficients
        self._rows, self._columns, self._size = self._nodes.shape
        self._lines = self._nodes.reshape(self._rows, -1)
        (self._x0_mm, self._y0_mm), self._per_mm = d.origin_mm, 1 / d.step_mm
        # Every place has its four neighbours, and lies on the plate.
        last = self._columns - 2, self._rows - 2
        self._low_mm = tuple(max(0.0, origin + d.step_mm) for origin in d.origin_mm)
        self._high_mm = tuple(
            min(size, origin + (count - 1e-4) * d.step_mm)
            for size, origin, count in zip((d.plate.width_mm, d.plate.height_mm), d.origin_mm, last, strict=True)
        )
        self._make_buffers()
        self.mask: NDArray[np.float32] | None = None
        """0 for each feature of a dead channel, 1 for the others; None if all are alive."""
        self.energy = 0.0
        """Of the frame taken in, counts squared."""

    def _make_buffers(self) -> None:
        n, parts = self._size, (self._channels, 2, self._bins)
        # u, its derivatives by x and y, the frame d, -i d and i u: real products with the last two are the imaginary
        # parts of the complex ones.
        self._rows_6 = np.zeros((6, n), np.float32)
        self._columns_6 = self._rows_6.T
        self._field, self._value_x, self._value_y = self._rows_6[:3], self._rows_6[:2], self._rows_6[2:3]
        self._frame: Array = self._rows_6[3]
        self._frame_parts, self._turned_frame = self._rows_6[3].reshape(parts), self._rows_6[4].reshape(parts)
        self._value_parts, self._turned_value = self._rows_6[0].reshape(parts), self._rows_6[5].reshape(parts)
        self._gram = np.zeros((3, 6), np.float32)
        self._information = np.zeros((2, 2))
        self._energy = np.zeros((), np.float32)
        self._factor = np.zeros((), np.float32)
        self._left = np.zeros(n, np.float32)
        self._part = np.zeros(n, np.float32)
        self._many = np.zeros((7, n), np.float32)  # two fingers; for more it grows
        self._many_turned = np.zeros_like(self._many)
        self._powers = np.zeros((4, 4), np.float32)
        self._powers[0, 0] = self._powers[2, 0] = 1
        self._powers[1, 1] = self._powers[3, 1] = self._per_mm
        self._weights = np.zeros((4, 4), np.float32)
        self._weights_x, self._weights_y, self._weight_x = self._weights[:2], self._weights[2:], self._weights[:1]
        self._along_y = np.zeros((2, 4 * n), np.float32)
        self._line_0, self._line_1 = self._along_y[0].reshape(4, n), self._along_y[1].reshape(4, n)

    @property
    def frame(self) -> Array:
        """The features of the frame to fit, shape (channels * 2 * bins,): fill it, then call `take`."""
        return self._frame

    def take(self) -> float:
        """Take in the frame in `frame`, and return its energy (counts squared)."""
        if self.mask is not None:
            np.multiply(self._frame, self.mask, out=self._frame)
        self._turned_frame[:, 0] = self._frame_parts[:, 1]
        np.negative(self._frame_parts[:, 0], out=self._turned_frame[:, 1])
        self._frame.dot(self._frame, self._energy)
        self.energy = self._energy.item()
        return self.energy

    def one(self, x_mm: float, y_mm: float, steps: int) -> Fit:
        """Fit one finger from a place nearby, in at most so many steps (at least one)."""
        x, y = self._inside(x_mm, y_mm)
        while True:
            self._look_up(x, y)
            strength, (a, b, c), (right_x, right_y), explained = self._normal_equations()
            steps -= 1
            det = a * c - b * b
            if det <= 0:
                break  # no gradient: nothing is known of where it is
            step_x, step_y = (c * right_x - b * right_y) / det, (a * right_y - b * right_x) / det
            length = (step_x * step_x + step_y * step_y) ** 0.5
            shorter = min(1.0, LONGEST_STEP_MM / length) if length else 1.0
            x, y = self._inside(x + shorter * step_x, y + shorter * step_y)
            if length < STILL_MM or steps <= 0:
                # What the last step explains besides, to second order: no need to look again.
                explained += right_x * step_x + right_y * step_y if shorter == 1.0 else 0.0
                break
        information = self._information
        information[0, 0], information[0, 1], information[1, 0], information[1, 1] = a, b, b, c
        return Fit([(x, y)], [strength], [explained], information, max(self.energy - explained, 0.0))

    def several(self, places_mm: Sequence[Place], steps: int) -> Fit:
        """Fit any number of fingers jointly from places nearby, in at most so many steps (at least one)."""
        count = len(places_mm)
        if not count:
            return Fit([], [], [], np.zeros((0, 0)), self.energy)
        at = np.array([self._inside(*place) for place in places_mm])
        order = np.arange(2 * count).reshape(2, count).T.ravel()  # from x of all, y of all to x and y of each in turn
        for step in range(steps + 1):
            gram, right = self._gram_of(at.tolist())
            own = gram[:count, :count] + 1e-6 * np.trace(gram[:count, :count]).real / count * np.eye(count)
            solved = np.linalg.solve(own, np.column_stack([gram[:count, count:], right[:count]]))
            z = solved[:, -1]
            twice = np.concatenate([z, z])
            inner = gram[count:, count:] - gram[count:, :count] @ solved[:, :-1]
            information = (twice.conj()[:, None] * inner * twice).real[order][:, order]
            if step == steps:
                break
            gradient = (twice.conj() * (right[count:] - gram[count:, :count] @ z)).real[order]
            damped = information + _DAMPING * np.diag(np.diag(information)) + 1e-30 * np.eye(2 * count)
            move = np.linalg.solve(damped, gradient).reshape(count, 2)
            length = np.sqrt(np.square(move).sum(axis=1, keepdims=True))
            move *= np.minimum(1.0, LONGEST_STEP_MM / np.maximum(length, 1e-12))
            at = np.minimum(np.maximum(at + move, self._low_mm), self._high_mm)
            if length.max() < STILL_MM / 10:
                break
        left = self.energy - float((z.conj() * right[:count]).real.sum())
        energies = (np.abs(z) ** 2 * np.diag(gram)[:count].real).tolist()
        places = [(float(x), float(y)) for x, y in at]
        return Fit(places, z.tolist(), energies, information, max(left, 0.0))

    def _gram_of(self, places_mm: Sequence[Sequence[float]]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the complex products of u of all fingers, then u_x, then u_y, with each other and with the frame."""
        count = len(places_mm)
        if 3 * count >= len(self._many):
            self._many = np.zeros((3 * count + 1, self._size), np.float32)
            self._many_turned = np.zeros_like(self._many)
        rows, turned = self._many[: 3 * count + 1], self._many_turned[: 3 * count + 1]
        for k, (x, y) in enumerate(places_mm):
            self._look_up(x, y)
            rows[k : 3 * count : count] = self._field
        rows[3 * count] = self._frame
        parts, turned_parts = (t.reshape(-1, self._channels, 2, self._bins) for t in (rows, turned))
        np.negative(parts[:, :, 1], out=turned_parts[:, :, 0])
        turned_parts[:, :, 1] = parts[:, :, 0]
        # With i b the real product of a and b turns into minus the imaginary part of conj(a) b.
        products = rows[:-1] @ rows.T - 1j * (rows[:-1] @ turned.T)
        table: NDArray[np.complex128] = products.astype(np.complex128)
        return table[:, :-1], table[:, -1]

    def shift(self, fit: Fit) -> Array:
        """Return the matrix from a small change of the frame to that of one finger's x and y, mm, (2, size)."""
        z = fit.strengths[0]
        self._look_up(*fit.places_mm[0])
        u, u_x, u_y = self._as_complex(self._field)
        parts = [z * (along - u * (np.vdot(u, along) / np.vdot(u, u))) for along in (u_x, u_y)]
        slope = np.stack([part.reshape(self._channels, self._bins) for part in parts])
        rows = np.stack([slope.real, slope.imag], axis=2).reshape(2, -1)
        return np.linalg.solve(fit.information, rows).astype(np.float32)

    def residual(self, fit: Fit) -> Array:
        """Return what a fit leaves of the frame, shape (channels * 2 * bins,); valid until it is asked again."""
        left, part = self._left, self._part
        np.copyto(left, self._frame)
        for (x, y), strength in zip(fit.places_mm, fit.strengths, strict=True):
            self._look_up(x, y)
            self._turn_value()
            for row, factor in ((self._rows_6[0], strength.real), (self._rows_6[5], strength.imag)):
                self._factor[...] = factor
                np.multiply(row, self._factor, out=part)
                np.subtract(left, part, out=left)
        return left

    def _inside(self, x_mm: float, y_mm: float) -> Place:
        (low_x, low_y), (high_x, high_y) = self._low_mm, self._high_mm
        # Written so that what is no number becomes the corner instead of an index.
        x = x_mm if low_x < x_mm < high_x else high_x if x_mm >= high_x else low_x
        y = y_mm if low_y < y_mm < high_y else high_y if y_mm >= high_y else low_y
        return x, y

    def _look_up(self, x_mm: float, y_mm: float) -> None:
        """Put the field and its derivatives (per mm) at a place into `_field`."""
        k = self._per_mm
        x, y = (x_mm - self._x0_mm) * k, (y_mm - self._y0_mm) * k
        column, row = int(x), int(y)
        s, t = x - column, y - row
        ss, tt, powers = s * s, t * t, self._powers
        powers[0, 1], powers[0, 2], powers[0, 3], powers[1, 2], powers[1, 3] = s, ss, ss * s, 2 * s * k, 3 * ss * k
        powers[2, 1], powers[2, 2], powers[2, 3], powers[3, 2], powers[3, 3] = t, tt, tt * t, 2 * t * k, 3 * tt * k
        np.dot(powers, _SPLINES, out=self._weights)
        n = self._size
        # Four neighbouring nodes of a row lie one after the other: the rows are summed first, without a copy.
        np.matmul(
            self._weights_y, self._lines[row - 1 : row + 3, (column - 1) * n : (column + 3) * n], out=self._along_y
        )
        np.dot(self._weights_x, self._line_0, out=self._value_x)
        np.dot(self._weight_x, self._line_1, out=self._value_y)
        if self.mask is not None:
            np.multiply(self._field, self.mask, out=self._field)

    def _normal_equations(self) -> tuple[complex, tuple[float, float, float], Place, float]:
        """Return the strength, Re(J^H J) as (xx, xy, yy), Re(J^H r), and the energy explained."""
        self._turn_value()
        np.dot(self._field, self._columns_6, out=self._gram)
        (uu, ux, uy, ud, ud_i, _), (_, xx, xy, xd, xd_i, ux_i), (_, _, yy, yd, yd_i, uy_i) = self._gram.tolist()
        if uu <= 0:
            return 0j, (0.0, 0.0, 0.0), (0.0, 0.0), 0.0
        z = complex(ud, ud_i) / uu
        power = z.real * z.real + z.imag * z.imag
        a = power * (xx - (ux * ux + ux_i * ux_i) / uu)
        b = power * (xy - (ux * uy + ux_i * uy_i) / uu)
        c = power * (yy - (uy * uy + uy_i * uy_i) / uu)
        turned = z.conjugate()
        right_x = (turned * (complex(xd, xd_i) - complex(ux, -ux_i) * z)).real
        right_y = (turned * (complex(yd, yd_i) - complex(uy, -uy_i) * z)).real
        return z, (a, b, c), (right_x, right_y), power * uu

    def _turn_value(self) -> None:
        """Put i u beside u."""
        np.negative(self._value_parts[:, 1], out=self._turned_value[:, 0])
        self._turned_value[:, 1] = self._value_parts[:, 0]

    def _as_complex(self, rows: Array) -> NDArray[np.complex64]:
        """Return rows of features (n, channels * 2 * bins) as complex bins (n, channels * bins)."""
        parts = rows.reshape(len(rows), self._channels, 2, self._bins)
        bins: NDArray[np.complex64] = parts[:, :, 0] + np.complex64(1j) * parts[:, :, 1]
        return bins.reshape(len(rows), -1)


def sigmas_mm(information: NDArray[np.float64], variance: float) -> list[float]:
    """Return each finger's standard error per axis, mm: the root mean square of both axes."""
    if information.shape == (2, 2):
        (a, b), (_, c) = information.tolist()
        det = a * c - b * b
        return [math.sqrt(variance * (a + c) / (2 * det))] if det > 0 else [math.inf]
    try:
        spread = np.diag(np.linalg.inv(information)) * variance
    except np.linalg.LinAlgError:
        return [math.inf] * (len(information) // 2)
    return [math.sqrt(pair) if pair > 0 else math.inf for pair in spread.reshape(-1, 2).mean(axis=1).tolist()]
