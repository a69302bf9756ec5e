"""From rough positions to precise ones: Gauss-Newton on the field atlas, the touches' strengths eliminated.

The bins d of a frame with c fingers are modelled as sum z_k u(x_k, y_k), the z_k complex and unknown. For
given places the best z follow by linear least squares; what is left over is made smaller by moving the
places (variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10:413, 1973; in the form of Kaufman,
BIT 15:49, 1975, which leaves out what the strengths' own change adds to the second order).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from touchd.localization.atlas import Array, Atlas
from touchd.localization.spline import Lookup, Place

LONGEST_STEP_MM = 3.0
"""About a tenth of the field's wavelength: a longer step would leave the valley that it starts in."""
STILL_MM = 0.2
"""After a shorter step the next one, of second order, would be less than 0.01 mm in 95 of 100 cases (twin)."""
_DAMPING = 1e-3


class Fit(Struct, gc=False, frozen=True):
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


NO_FIT = Fit([], [], [], np.zeros((0, 0)), 0.0)
"""No fingers, which explain nothing."""


class Refiner:
    """Fits fingers to one frame at a time.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        d = atlas.description
        self._channels, self._bins, n = d.acquisition.channels, len(d.bins), atlas.size
        # Here each row is the real parts of all channels, then the imaginary parts, so that one product of rows with
        # rows, half by half, holds all parts of the complex ones. The rows are u, its derivatives by x and y, and d.
        order = np.arange(n).reshape(self._channels, 2, self._bins).swapaxes(0, 1).reshape(-1)
        self._order, self._back = order, np.argsort(order)
        rows = np.zeros((4, n), np.float32)
        self._field, self._known = rows[:3], rows[3]
        halves = rows.reshape(8, -1)
        self._fields, self._columns, self._value = halves[:6], halves.T, halves[:2]
        self._lookup = Lookup(atlas, self._field)
        self._gram = np.zeros((6, 8), np.float32)
        self._information = np.zeros((2, 2))
        self._energy = np.zeros((), np.float32)
        self._turn = np.zeros((2, 2), np.float32)
        self._left, self._part = np.zeros((2, n // 2), np.float32), np.zeros((2, n // 2), np.float32)
        self._residual = np.zeros(n, np.float32)
        self._many = np.zeros((7, n), np.float32)  # two fingers; for more it grows
        self._mask: NDArray[np.float32] | None = None
        self._heard: NDArray[np.float32] | None = None
        self.frame: Array = np.zeros(n, np.float32)
        """The features of the frame to fit, shape (channels * 2 * bins,): fill it, then call `take`."""
        self.energy = 0.0
        """Of the frame taken in, counts squared."""

    @property
    def mask(self) -> NDArray[np.float32] | None:
        """0 for each feature that is left out, 1 for the others; None if all are heard."""
        return self._mask

    @mask.setter
    def mask(self, mask: NDArray[np.float32] | None) -> None:
        self._mask = mask
        self._heard = None if mask is None else mask[self._order]

    def take(self) -> float:
        """Take in the frame in `frame`, and return its energy (counts squared)."""
        frame = self.frame
        if self._mask is not None:
            np.multiply(frame, self._mask, frame)
        frame.take(self._order, 0, self._known, "wrap")  # in this mode it needs no copy
        frame.dot(frame, self._energy)
        self.energy = self._energy.item()
        return self.energy

    def one(self, x_mm: float, y_mm: float, steps: int) -> Fit:
        """Fit one finger from a place nearby, in at most so many steps (at least one)."""
        inside = self._lookup.inside
        x, y = inside(x_mm, y_mm)
        while True:
            x, y = self._look_up(x, y)
            strength, a, b, c, right_x, right_y, explained, along_x, along_y = self._normal_equations()
            steps -= 1
            det = a * c - b * b
            if det <= 0:
                break  # no gradient: nothing is known of where it is
            step_x, step_y = (c * right_x - b * right_y) / det, (a * right_y - b * right_x) / det
            length = (step_x * step_x + step_y * step_y) ** 0.5
            shorter = LONGEST_STEP_MM / length if length > LONGEST_STEP_MM else 1.0
            x, y = inside(x + shorter * step_x, y + shorter * step_y)
            if length < STILL_MM or steps <= 0:
                # What the last step explains besides, to second order: no need to look again.
                if shorter == 1.0:
                    explained += right_x * step_x + right_y * step_y
                    strength /= 1 + step_x * along_x + step_y * along_y
                break
        information = self._information
        information[0, 0], information[0, 1], information[1, 0], information[1, 1] = a, b, b, c
        return Fit([(x, y)], [strength], [explained], information, max(self.energy - explained, 0.0))

    def several(self, places_mm: Sequence[Place], steps: int, still_mm: float = STILL_MM / 10) -> Fit:
        """Fit any number of fingers jointly from places nearby, in at most so many steps (at least one).

        Steps shorter than `still_mm` end it.
        """
        count = len(places_mm)
        if not count:
            return Fit([], [], [], np.zeros((0, 0)), self.energy)
        inside, pair = self._lookup.inside, np.arange(2 * count).reshape(2, count).T.ravel()
        at, gained = [inside(*place) for place in places_mm], 0.0
        for step in range(steps + 1):
            at, gram = self._gram_of(at)
            own = gram[:count, :count].copy()
            own.ravel()[:: count + 1] += 1e-6 / count * own.trace().real
            solved = np.linalg.solve(own, gram[:count, count:])
            z = strengths = solved[:, -1]
            twice = np.concatenate([z, z])
            # What the strengths leave of the products of the derivatives with each other, and with the frame.
            inner = twice.conj()[:, None] * (gram[count:, count:] - gram[count:, :count] @ solved)
            inner[:, :-1] *= twice
            system = inner.real[pair]  # from x of all, y of all to x and y of each in turn
            information, gradient = system[:, pair], system[:, -1]
            if step == steps:
                break
            damped = information.copy()
            damped.ravel()[:: 2 * count + 1] *= 1 + _DAMPING
            damped.ravel()[:: 2 * count + 1] += 1e-30
            move = np.linalg.solve(damped, gradient)
            longest_mm, places, steps_mm = 0.0, [], move.tolist()
            for (x, y), step_x, step_y in zip(at, steps_mm[::2], steps_mm[1::2], strict=True):
                length = math.hypot(step_x, step_y)
                shorter = LONGEST_STEP_MM / length if length > LONGEST_STEP_MM else 1.0
                places.append(inside(x + shorter * step_x, y + shorter * step_y))
                longest_mm = max(longest_mm, length)
            at = places
            if longest_mm < still_mm:
                # What the last step changes, to second order and to first, as with one finger.
                gained = float(gradient @ move)
                strengths = z - (solved[:, :count] * move[::2] + solved[:, count:-1] * move[1::2]) @ z
                break
        left = self.energy - (z.conj() @ gram[:count, -1]).real - gained
        norms = gram.diagonal()[:count].real.tolist()
        energies = [abs(strength) ** 2 * norm for strength, norm in zip(z.tolist(), norms, strict=True)]
        return Fit(at, strengths.tolist(), energies, information, max(float(left), 0.0))

    def _gram_of(self, places_mm: Sequence[Place]) -> tuple[list[Place], NDArray[np.complex128]]:
        """Return the places looked up, and the complex products of u, then u_x, then u_y of all fingers.

        They are those with each other and, in the last column, with the frame.
        """
        count = len(places_mm)
        length = 3 * count + 1
        if length > len(self._many):
            self._many = np.zeros((length, len(self.frame)), np.float32)
        rows = self._many[:length]
        at = []
        for k, place in enumerate(places_mm):
            at.append(self._look_up(*place))
            rows[k : 3 * count : count] = self._field
        rows[-1] = self._known
        halves = rows.reshape(2 * length, -1)
        products = halves[:-2] @ halves.T
        of_real, of_imaginary = products[::2], products[1::2]
        table = np.empty((length - 1, length), np.complex128)
        np.add(of_real[:, ::2], of_imaginary[:, 1::2], table.real)
        np.subtract(of_real[:, 1::2], of_imaginary[:, ::2], table.imag)
        return at, table

    def shift(self, fit: Fit) -> Array:
        """Return the matrix from a small change of the frame to that of one finger's x and y, mm, (2, size)."""
        z = fit.strengths[0]
        self._look_up(*fit.places_mm[0])
        real, imaginary = self._field.reshape(3, 2, -1).swapaxes(0, 1)
        u, u_x, u_y = real + np.complex64(1j) * imaginary
        parts = [z * (along - u * (np.vdot(u, along) / np.vdot(u, u))) for along in (u_x, u_y)]
        slope = np.stack([part.reshape(self._channels, self._bins) for part in parts])
        rows = np.stack([slope.real, slope.imag], axis=2).reshape(2, -1)
        return np.linalg.solve(fit.information, rows).astype(np.float32)

    def residual(self, fit: Fit) -> Array:
        """Return what a fit leaves of the frame, shape (channels * 2 * bins,); valid until it is asked again."""
        left, turn = self._left, self._turn
        left[...] = self._known.reshape(2, -1)
        for (x, y), strength in zip(fit.places_mm, fit.strengths, strict=True):
            self._look_up(x, y)
            turn[0, 0] = turn[1, 1] = strength.real
            turn[1, 0], turn[0, 1] = strength.imag, -strength.imag
            turn.dot(self._value, self._part)
            np.subtract(left, self._part, left)
        left.take(self._back, None, self._residual, "wrap")
        return self._residual

    def _look_up(self, x_mm: float, y_mm: float) -> Place:
        """Put the field and its derivatives (per mm) at a place into `_field`, and return that place."""
        place = self._lookup.at(x_mm, y_mm)
        if self._heard is not None:
            np.multiply(self._field, self._heard, self._field)
        return place

    def _normal_equations(self) -> tuple[complex, float, float, float, float, float, float, complex, complex]:
        """Return the strength, Re(J^H J) as xx, xy, yy, both parts of Re(J^H r), the energy explained, and more.

        The last two are the parts of u_x and u_y along u: to first order, what a step of 1 mm adds to the field.
        """
        self._fields.dot(self._columns, self._gram)
        # Products of real (r) and imaginary parts (i) of u (0), u_x, u_y and the frame.
        (
            (r0r0, _, r0rx, r0ix, r0ry, r0iy, r0rd, r0id), (_, i0i0, i0rx, i0ix, i0ry, i0iy, i0rd, i0id),
            (_, _, rxrx, _, rxry, _, rxrd, rxid), (_, _, _, ixix, _, ixiy, ixrd, ixid),
            (_, _, _, _, ryry, _, ryrd, ryid), (_, _, _, _, _, iyiy, iyrd, iyid),
        ) = self._gram.tolist()  # fmt: skip
        uu = r0r0 + i0i0
        if uu <= 0:
            return 0j, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0j, 0j
        z, z_i = (r0rd + i0id) / uu, (r0id - i0rd) / uu
        ux, ux_i, uy, uy_i = r0rx + i0ix, r0ix - i0rx, r0ry + i0iy, r0iy - i0ry
        power = z * z + z_i * z_i
        a = power * (rxrx + ixix - (ux * ux + ux_i * ux_i) / uu)
        b = power * (rxry + ixiy - (ux * uy + ux_i * uy_i) / uu)
        c = power * (ryry + iyiy - (uy * uy + uy_i * uy_i) / uu)
        right_x = z * (rxrd + ixid) + z_i * (rxid - ixrd) - power * ux
        right_y = z * (ryrd + iyid) + z_i * (ryid - iyrd) - power * uy
        along_x, along_y = complex(ux / uu, ux_i / uu), complex(uy / uu, uy_i / uu)
        return complex(z, z_i), a, b, c, right_x, right_y, power * uu, along_x, along_y


def sigmas_mm(information: NDArray[np.float64], variance: float) -> list[float]:
    """Return each finger's standard error per axis, mm: the root mean square of both axes."""
    if information.shape == (2, 2):
        (a, b), (_, c) = information.tolist()
        det = a * c - b * b
        return [math.sqrt(variance * (a + c) / (2 * det))] if det > 0 else [math.inf]
    try:
        spread = np.linalg.inv(information).diagonal().tolist()
    except np.linalg.LinAlgError:
        return [math.inf] * (len(information) // 2)
    pairs = [variance * (x + y) / 2 for x, y in zip(spread[::2], spread[1::2], strict=True)]
    return [math.sqrt(pair) if pair > 0 else math.inf for pair in pairs]
