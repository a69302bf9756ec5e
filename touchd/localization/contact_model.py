"""Contacts with a size and a shape: the second derivatives of the field beside the field itself.

A finger's face is as wide as the wave is long per radian, and follows the wave. About its middle the field of such a
contact is z u + a u_xx + b u_yy + c u_xy to second order in its size, with z linear along the band; u is what the
atlas holds for a small contact. All five amplitudes are eliminated (variable projection, as in `gauss_newton`), and
Gauss-Newton moves the middles. A prior on tissue bounds a, b and c where a faint touch cannot tell them.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Array, Atlas
from touchd.localization.fit import SHAPE_COST, Bins, Fit, Steps
from touchd.localization.scattering import Scattering
from touchd.localization.spline import TERMS, ContactField, Position, Shape

LONGEST_STEP_MM = 2.0
STILL_MM = 0.1
"""After a shorter step the next one would be of micrometres."""
TYPICAL: Shape = (0j, 1.2 * cmath.exp(0.4j), 1.2 * cmath.exp(0.4j), 0j)
"""Of tissue, between a child's finger and a thumb: u_xx and u_yy have 0.4 to 4 mm^2 over z at 0.4 rad (twin)."""
LARGE: Shape = (0j, 3.5 * cmath.exp(0.4j), 3.5 * cmath.exp(0.4j), 0j)
"""Of a thumb that presses."""
LARGE_MM2 = 2.7
"""Thumbs that press have a larger mean moment."""
_SIZE_SPREAD_MM2, _OVAL_SPREAD_MM2, _SLOPE_SPREAD = 2.0, 1.2, 0.2
"""Standard deviations about it: of the mean of a and b, of half their difference and of c, and of the slope, over z."""
_AMPLITUDES, _SLOPES = 5, 8
_DAMPING = 1e-6

Complex = NDArray[np.complex128]


class ContactModel:
    """Fits contacts of unknown size and shape to the bins of a frame.

    Parameters
    ----------
    atlas : Atlas
    field : ContactField
    """

    def __init__(self, atlas: Atlas, field: ContactField) -> None:
        self._field = field
        self.scattering = Scattering(atlas) if atlas.modes else None
        """Of an atlas that knows how contacts scatter each other's waves."""
        half, dtype = atlas.size // 2, atlas.coefficients.dtype
        self._shape = atlas.description.acquisition.channels, 2, len(atlas.description.bins)
        self._block = np.zeros((2, 10, half), dtype)
        # The rows of all contacts that have an amplitude, then those of their slopes; at last the frame. In double
        # precision: what many amplitudes leave of the frame is a small difference of large products.
        self._rows = np.zeros((2, _AMPLITUDES + _SLOPES + 1, half))
        self._mask: Array | None = None
        self.steps = 0
        """Steps of a contact so far."""

    def pieces(
        self, bins: Bins, positions_mm: Sequence[Position], variance: float, steps: int, unexplained: float = 0.0,
        whiten: Complex | None = None,
    ) -> Steps[Fit]:  # fmt: skip
        """Fit contacts jointly from positions nearby, in at most `steps` steps (at least one).

        Parameters
        ----------
        bins : Bins
            They must stay valid until the end.
        positions_mm : sequence of c positions, at least one
        variance : float
            Of the noise of a value, counts squared: it weighs the prior.
        steps : int
        unexplained : float
            Energy that is left at the positions: where fingers are missing it weighs the prior instead.
        whiten : array of shape (bins, channels, channels), optional
            What makes errors of all channels of a bin white, of the same variance: all energies are then of such bins.
        """
        count = len(positions_mm)
        own = _AMPLITUDES * count
        at = [self._field.inside(*position) for position in positions_mm]
        sizes, scattered = [1.0] * count, None
        # The first look, as at reference touches, only tells how heavy they are, and the next one what they scatter.
        looks = 2 if self.scattering and count > 1 else 1 if self._field.loading else 0
        while True:
            self._load(bins, count)  # others may have been fitted since the last piece
            at, gram = self._gram(at, sizes, whiten)
            normal, right = gram[:own, :own], gram[:own, -1]
            ridge = _ridge(normal, right, max(variance, unexplained / bins.vector.size))
            solved = np.linalg.solve(normal + ridge, gram[:own, own:])
            amplitudes = solved[:, -1]
            if self._field.loading:
                as_points = _as_points(normal, amplitudes)
                sizes = list(map(abs, as_points))
                if looks:
                    if looks == 1 and self.scattering and count > 1:
                        bins, scattered = self.scattering.take_out(bins, at, as_points)
                    looks -= 1
                    continue
            unexplained = float((gram[-1, -1] - amplitudes.conj() @ (right + ridge @ amplitudes)).real)
            slopes = _slopes(amplitudes.reshape(count, _AMPLITUDES))
            # What the amplitudes leave of the products of the slopes with each other, and with the frame.
            left = slopes.conj() @ (gram[own:-1, own:] - gram[:own, own:-1].conj().T @ solved)
            information, gradient = (left[:, :-1] @ slopes.T).real, left[:, -1].real
            damped = information.copy()
            damped.ravel()[:: 2 * count + 1] *= 1 + _DAMPING
            damped.ravel()[:: 2 * count + 1] += 1e-30
            move = np.linalg.solve(damped, gradient)
            longest_mm, at = self._field.moved(at, move.tolist(), LONGEST_STEP_MM)
            steps -= 1
            if steps <= 0 or longest_mm < STILL_MM:
                break
            yield SHAPE_COST * count
        if longest_mm <= LONGEST_STEP_MM:
            # What the last step changes, to second order and to first: no need to look again.
            unexplained -= float(gradient @ move)
            amplitudes = amplitudes - solved[:, :-1] @ (slopes.T @ move)
        energies, turns = [], []
        for k in range(0, own, _AMPLITUDES):
            part = amplitudes[k : k + _AMPLITUDES]
            along = normal[k : k + _AMPLITUDES, k : k + _AMPLITUDES] @ part
            energies.append(float((part.conj() @ along).real))
            as_point, alone = complex(along[0]), complex(normal[k, k] * part[0])
            turns.append(as_point / alone if alone else 1 + 0j)
        per_contact = amplitudes.reshape(count, _AMPLITUDES).tolist()
        return Fit(
            at,
            [z for z, *_ in per_contact],
            energies,
            information.tolist(),
            max(unexplained, 0.0),
            [[slope, *second] for _, *second, slope in per_contact],
            turns,
            scattered=scattered,
        )

    def _load(self, bins: Bins, count: int) -> None:
        """Put the bins into the last row."""
        needed = (_AMPLITUDES + _SLOPES) * count + 1
        if needed > self._rows.shape[1]:
            self._rows = np.zeros((2, needed, self._rows.shape[2]))
        parts = bins.vector.reshape(self._shape).swapaxes(0, 1)
        np.copyto(self._rows[:, needed - 1].reshape(parts.shape), parts)
        self._mask = None if bins.mask is None else bins.mask.reshape(self._shape)[:, 0].ravel()

    def _gram(
        self, positions_mm: Sequence[Position], sizes: Sequence[float], whiten: Complex | None
    ) -> tuple[list[Position], Complex]:
        """Return the raster points, and the complex products of all rows with each other."""
        count, block, band, at = len(positions_mm), self._block, self._field.band, []
        last = (_AMPLITUDES + _SLOPES) * count
        rows = self._rows[:, : last + 1]
        self.steps += count
        for k, position in enumerate(positions_mm):
            at.append(self._field.derivatives(*position, block, sizes[k]))
            if self._mask is not None:
                np.multiply(block, self._mask, block)
            own, slope = _AMPLITUDES * k, _AMPLITUDES * count + _SLOPES * k
            rows[:, own : own + 4] = block[:, :4]
            np.multiply(block[:, 0], band, rows[:, own + 4])
            rows[:, slope : slope + 6] = block[:, 4:]
            np.multiply(block[:, 4:6], band, rows[:, slope + 6 : slope + 8])
        if whiten is not None:
            channels, _, bins = self._shape
            parts = rows.reshape(2, last + 1, channels, bins).transpose(0, 3, 2, 1)
            white = (whiten @ (parts[0] + 1j * parts[1])).reshape(-1, last + 1)
            return at, white.conj().T @ white
        flat = rows.reshape(2 * (last + 1), -1)
        products = flat @ flat.T
        n = last + 1
        gram = np.empty((n, n), np.complex128)
        np.add(products[:n, :n], products[n:, n:], gram.real)
        np.subtract(products[:n, n:], products[n:, :n], gram.imag)
        return at, gram


def _as_points(normal: Complex, amplitudes: NDArray[np.complexfloating]) -> list[complex]:
    """Return contacts' amplitudes as points', from the products of their rows."""
    found = []
    for k in range(0, len(amplitudes), _AMPLITUDES):
        part = slice(k, k + _AMPLITUDES)
        found.append(complex(normal[k, part] @ amplitudes[part]) / max(float(normal[k, k].real), 1e-30))
    return found


def size_mm2(fit: Fit) -> float:
    """Return the largest second-order amplitude over z in a fit, mm^2: the moment of a contact's face."""
    return max(
        max(map(abs, second)) / max(abs(z), 1e-30) for z, (_, *second) in zip(fit.amplitudes, fit.shapes, strict=True)
    )


def mean_moment_mm2(amplitude: complex, shape: Sequence[complex]) -> float:
    """Return the mean of a contact's second moments along x and y, over its amplitude, mm^2."""
    _, xx, yy, _ = shape
    return abs(xx + yy) / 2 / max(abs(amplitude), 1e-30)


def radius_mm(amplitude: complex, shape: Sequence[complex]) -> float:
    """Return roughly the radius of a contact's face: 3.7 times the root of its mean second moment (twin)."""
    return 3.7 * math.sqrt(mean_moment_mm2(amplitude, shape))


def elongation(fit: Fit) -> float:
    """Return the largest difference of second moments over their sum in a fit: up to 0.55 of one finger (twin)."""
    return max(math.hypot(abs(xx - yy), abs(xy)) / max(abs(xx + yy), 1e-30) for _, xx, yy, xy in fit.shapes)


def oval_mm2(fit: Fit) -> float:
    """Return by how much the second moments of the most oval contact of a fit differ from those of a disc."""
    return max(
        max(abs(xx - yy) / 2, abs(xy)) / max(abs(z), 1e-30)
        for z, (_, xx, yy, xy) in zip(fit.amplitudes, fit.shapes, strict=True)
    )


def _mix() -> Complex:
    """Return how amplitudes mix rows to the slopes by x and by y, shape (5, 2 * 8).

    Rows: u_x, u_y, the third derivatives, then u_x and u_y along the band.
    """
    mix = np.zeros((_AMPLITUDES, 2, _SLOPES), complex)
    for along, orders in enumerate(TERMS[1:]):
        for amplitude, order in enumerate(orders):
            mix[amplitude, along, order - 4] = 1
        mix[-1, along, 6 + along] = 1
    return mix.reshape(_AMPLITUDES, -1)


_MIX = _mix()


def _slopes(per_contact: NDArray[np.complexfloating]) -> Complex:
    """Return the slopes by x and y of each contact in turn as sums of rows, shape (2 c, 8 c)."""
    count = len(per_contact)
    mixed = (per_contact @ _MIX).reshape(count, 2, _SLOPES)
    if count == 1:
        return np.asarray(mixed[0])
    slopes = np.zeros((count, 2, count, _SLOPES), complex)
    each = np.arange(count)
    slopes[each, :, each] = mixed
    return slopes.reshape(2 * count, -1)


def _prior() -> Complex:
    """Return the inverse covariance of a contact's amplitudes (of u, u_xx, u_yy, u_xy, and u along the band) over z."""
    typical = TYPICAL[1]
    deviations = np.array([
        [-typical / _SIZE_SPREAD_MM2, *[0.5 / _SIZE_SPREAD_MM2] * 2, 0, 0],
        [0, 0.5 / _OVAL_SPREAD_MM2, -0.5 / _OVAL_SPREAD_MM2, 0, 0],
        [0, 0, 0, 1 / _OVAL_SPREAD_MM2, 0],
        [0, 0, 0, 0, 1 / _SLOPE_SPREAD],
    ])  # fmt: skip
    return np.asarray(deviations.conj().T @ deviations)


_PRIOR = _prior()


def _ridge(normal: Complex, right: Complex, variance: float) -> Complex:
    """Return what the prior adds to the normal equations, shape (5 c, 5 c): noise over the amplitudes' variance.

    The amplitude of u alone says how large the others may be. Something stays where the field is zero.
    """
    ridge = np.zeros_like(normal)
    for k in range(0, len(normal), _AMPLITUDES):
        own = max(float(normal[k, k].real), 1e-30)
        size = abs(complex(right[k])) / own
        part = slice(k, k + _AMPLITUDES)
        ridge[part, part] = 2 * variance / max(size * size, 1e-30) * _PRIOR
    ridge.ravel()[:: len(normal) + 1] += 1e-12 * normal.diagonal().real + 1e-30
    return ridge
