"""Contacts with a size and a shape: the second derivatives of the field beside the field itself.

A finger's face is as wide as the wave is long per radian, and follows the wave. About its middle the field of such a
contact is z u + a u_xx + b u_yy + c u_xy to second order in its size, with z linear along the band; u is what the
atlas holds for a small contact. All five amplitudes are eliminated (variable projection, as in `gauss_newton`), and
Gauss-Newton moves the middles. A prior on tissue bounds a, b and c where a faint touch cannot tell them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Array, Atlas
from touchd.localization.fit import Bins, Fit
from touchd.localization.spline import Position, known_part_mm

LONGEST_STEP_MM = 2.0
STILL_MM = 0.02
"""After a shorter step the next one would be of micrometres."""
PRIOR_MM2 = 6.0
"""Standard deviation of a, b and c over z. A fingertip has 2 to 5 mm^2, a thumb 4 to 8 (twin)."""
PRIOR_SLOPE = 0.3
"""Standard deviation of the amplitude's slope from the middle of the band to its edge, over z."""
AMPLITUDES = 5
_BSPLINE = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float64) / 6
_DERIVATIVES = ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2), (1, 1), (3, 0), (0, 3), (2, 1), (1, 2))
"""Orders along x and y of the rows that a look-up returns."""
_U, _XX, _YY, _XY = 0, 3, 4, 5
_ALONG_X = (1, 6, 9, 8)
"""Rows of the derivatives by x of u, u_xx, u_yy and u_xy."""
_ALONG_Y = (2, 8, 7, 9)

Complex = NDArray[np.complexfloating]


class ContactModel:
    """Fits contacts of unknown size and shape to the bins of a frame.

    Parameters
    ----------
    atlas : Atlas
        Its coefficients' type is that of all arrays.
    """

    def __init__(self, atlas: Atlas) -> None:
        d = atlas.description
        rows, columns, size = atlas.coefficients.shape
        self._dtype = np.result_type(atlas.coefficients.dtype, np.complex64)
        self._shape = d.acquisition.channels, 2, len(d.bins)
        parts = atlas.coefficients.reshape(rows, columns, *self._shape)
        nodes = (parts[..., 0, :] + 1j * parts[..., 1, :]).astype(self._dtype)
        self._nodes = nodes.reshape(rows, columns, size // 2)
        self._origin_mm, self._step_mm = d.origin_mm, d.step_mm
        self._low_mm, self._high_mm = known_part_mm(atlas)
        bins = np.array(d.bins, float)
        middle, half = (bins[0] + bins[-1]) / 2, max((bins[-1] - bins[0]) / 2, 1.0)
        self._band = np.tile((bins - middle) / half, d.acquisition.channels).astype(atlas.coefficients.dtype)

    def fit(self, bins: Bins, positions_mm: Sequence[Position], variance: float, steps: int) -> Fit:
        """Fit contacts jointly from positions nearby, in at most `steps` steps (at least one).

        Parameters
        ----------
        bins : Bins
        positions_mm : sequence of c positions, at least one
        variance : float
            Of the noise of a value, counts squared: it weighs the prior.
        steps : int
        """
        frame, mask = self._complex(bins.vector), self._mask(bins)
        at = [self._inside(*position) for position in positions_mm]
        count = len(at)
        for step in range(steps + 1):
            rows = [self._look_up(*position, mask) for position in at]
            columns = self._columns(rows)
            normal, right = columns.conj() @ columns.T, columns.conj() @ frame
            ridge = self._ridge(normal, right, variance)
            solved = normal + np.diag(ridge)
            amplitudes = np.linalg.solve(solved, right)
            left = frame - amplitudes @ columns
            slopes = self._slopes(rows, amplitudes.reshape(count, AMPLITUDES))
            slopes = slopes - np.linalg.solve(solved, columns.conj() @ slopes.T).T @ columns
            information = (slopes.conj() @ slopes.T).real.astype(np.float64)
            if step == steps:
                break
            damped = information + np.diag(1e-6 * information.diagonal() + 1e-30)
            moves = np.linalg.solve(damped, (slopes.conj() @ left).real).reshape(count, 2)
            lengths = np.hypot(*moves.T)
            moves *= np.minimum(1.0, LONGEST_STEP_MM / np.maximum(lengths, 1e-12))[:, None]
            at = [self._inside(x + dx, y + dy) for (x, y), (dx, dy) in zip(at, moves.tolist(), strict=True)]
            if lengths.max() < STILL_MM:
                steps = step + 1  # one look at the last place, for the amplitudes there
        fields = (amplitudes[:, None] * columns).reshape(count, AMPLITUDES, -1).sum(axis=1)
        per_contact = amplitudes.reshape(count, AMPLITUDES)
        return Fit(
            at,
            per_contact[:, 0].tolist(),
            np.square(np.abs(fields)).sum(axis=1).tolist(),
            information.tolist(),
            float(np.vdot(left, left).real),
            per_contact[:, 1:].tolist(),
        )

    def residual(self, bins: Bins, fit: Fit) -> Array:
        """Return what a fit with shapes leaves of the bins, shape (channels * 2 * bins,)."""
        mask = self._mask(bins)
        columns = self._columns([self._look_up(*position, mask) for position in fit.positions_mm])
        amplitudes = np.column_stack([fit.amplitudes, fit.shapes]).astype(self._dtype).ravel()
        left = (self._complex(bins.vector) - amplitudes @ columns).reshape(self._shape[0], 1, self._shape[2])
        return np.concatenate([left.real, left.imag], axis=1).reshape(-1)

    def size_mm2(self, fit: Fit) -> float:
        """Return the largest second-order amplitude over z in a fit, mm^2: the moment of a contact's face."""
        return max(
            max(map(abs, second)) / max(abs(z), 1e-30)
            for z, (_, *second) in zip(fit.amplitudes, fit.shapes, strict=True)
        )

    def _columns(self, rows: Sequence[Complex]) -> Complex:
        """Return the fields of the five amplitudes of each contact, shape (5 c, size)."""
        return np.concatenate([[one[_U], one[_U] * self._band, one[_XX], one[_YY], one[_XY]] for one in rows])

    def _slopes(self, rows: Sequence[Complex], amplitudes: Complex) -> Complex:
        """Return the derivatives of the frame by x and y of each contact in turn, shape (2 c, size)."""
        slopes = []
        for one, (z, slope, *second) in zip(rows, amplitudes, strict=True):
            along_band = z + slope * self._band
            for first, *others in (_ALONG_X, _ALONG_Y):
                slopes.append(along_band * one[first] + np.asarray(second) @ one[list(others)])
        return np.asarray(slopes)

    def _ridge(self, normal: Complex, right: Complex, variance: float) -> Array:
        """Return what the prior adds to the normal equations, shape (5 c,): noise over the amplitudes' variance."""
        power = np.square(np.abs(right[::AMPLITUDES])) / np.square(normal.diagonal()[::AMPLITUDES].real)
        spread = np.array([np.inf, PRIOR_SLOPE, PRIOR_MM2, PRIOR_MM2, PRIOR_MM2]) ** 2
        return np.asarray((2 * variance / np.maximum(power, 1e-30))[:, None] / spread).ravel()

    def _look_up(self, x_mm: float, y_mm: float, mask: Array | None) -> Complex:
        """Return the field and its derivatives up to the third that are needed, per mm, shape (10, size)."""
        across, down = ((at - low) / self._step_mm for at, low in zip((x_mm, y_mm), self._origin_mm, strict=True))
        column, row = int(across), int(down)
        of_x, of_y = (self._weights(part) for part in (across - column, down - row))
        weights = np.array([np.multiply.outer(of_y[j], of_x[i]).ravel() for i, j in _DERIVATIVES])
        near = self._nodes[row - 1 : row + 3, column - 1 : column + 3].reshape(16, -1)
        found: Complex = weights.astype(near.real.dtype) @ near
        return found if mask is None else np.asarray(found * mask)

    def _weights(self, t: float) -> NDArray[np.float64]:
        """Return the weights of four nodes for the value and three derivatives, shape (4, 4)."""
        powers = np.array([[1, t, t * t, t**3], [0, 1, 2 * t, 3 * t * t], [0, 0, 2, 6 * t], [0, 0, 0, 6]])
        return np.asarray(powers @ _BSPLINE / self._step_mm ** np.arange(4)[:, None])

    def _inside(self, x_mm: float, y_mm: float) -> Position:
        # Written so that NaN becomes a corner instead of an index.
        x, y = (
            at if low < at < high else high if at >= high else low
            for at, low, high in zip((x_mm, y_mm), self._low_mm, self._high_mm, strict=True)
        )
        return x, y

    def _complex(self, vector: Array) -> Complex:
        parts = vector.reshape(self._shape)
        return np.asarray(parts[:, 0] + 1j * parts[:, 1]).ravel()

    def _mask(self, bins: Bins) -> Array | None:
        return None if bins.mask is None else bins.mask.reshape(self._shape)[:, 0].ravel()
