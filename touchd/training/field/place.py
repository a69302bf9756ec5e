"""Locate many touches on a field atlas at once, in float64: for calibration, and as reference of the daemon's path.

The method is that of `touchd.localization.gauss_newton` for one finger: eliminate the amplitude, then minimise the
unexplained energy over the position (variable projection, Golub and Pereyra 1973).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline

from touchd.localization.atlas import Atlas

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

LONGEST_STEP_MM = 3.0
BEYOND_MM = 3.0
"""Margin around the touched part in which a touch may be located."""
_DAMPING = 1e-3


@dataclass(frozen=True, slots=True)
class Placed:
    """n touches after Gauss-Newton."""

    position_mm: Floats
    """Shape (n, 2)."""
    amplitude: Complex
    """Shape (n,)."""
    fisher_information: Floats
    """Re(J^H J) with the amplitude projected out, shape (n, 2, 2), counts squared per mm^2. Its inverse times the noise
    variance of a real feature is the covariance of the position."""
    misfit: Floats
    """Share of the energy that is unexplained, shape (n,)."""


class Linearised(NamedTuple):
    """n touches near assumed positions, with the amplitude eliminated; c parts of their values."""

    amplitude: Complex
    """Shape (n,)."""
    residual_energy: Floats
    """Shape (n,)."""
    gradient: Floats
    """Share of each part in that of half the explained energy by position, shape (n, c, 2)."""
    fisher_information: Floats
    """Share of each part, shape (n, c, 2, 2)."""


def linearise(values: Complex, u: Complex, by_x: Complex, by_y: Complex, parts: int = 1) -> Linearised:
    """Fit the amplitudes of touches (n, m) to the field `u` at assumed positions, with derivatives `by_x`, `by_y`.

    All have the shape (n, m). Gradient and information are summed in `parts` equal parts of the values.
    """
    power = np.maximum(np.square(np.abs(u)).sum(axis=1), 1e-30)
    amplitude = (u.conj() * values).sum(axis=1) / power
    left = values - amplitude[:, None] * u
    moved = amplitude[:, None, None] * np.stack([by_x, by_y], axis=1)
    moved -= ((moved @ u.conj()[:, :, None]) / power[:, None, None]) * u[:, None, :]
    moved = moved.reshape(len(values), 2, parts, -1).swapaxes(1, 2)
    gradient = (moved.conj() @ left.reshape(len(values), parts, -1, 1))[..., 0].real
    fisher_information = (moved.conj() @ moved.swapaxes(2, 3)).real
    return Linearised(amplitude, np.square(np.abs(left)).sum(axis=1), gradient, fisher_information)


def complex_nodes(atlas: Atlas) -> Complex:
    """Return an atlas' coefficients as complex numbers, shape (rows, columns, channels, bins)."""
    d = atlas.description
    parts = atlas.coefficients.reshape(*atlas.coefficients.shape[:2], d.acquisition.channels, 2, len(d.bins))
    return np.asarray(parts[:, :, :, 0] + 1j * parts[:, :, :, 1], np.complex128)


def real_nodes(nodes: Complex) -> NDArray[np.float32]:
    """Return complex coefficients (rows, columns, channels, bins) as an atlas has them: undo `complex_nodes`."""
    parts = np.stack([nodes.real, nodes.imag], axis=3)
    return np.ascontiguousarray(parts.reshape(*nodes.shape[:2], -1), np.float32)


def yields_of(atlas: Atlas) -> Complex:
    """Return the coefficients of an atlas' yields as complex numbers, shape (rows, columns, 1, bins)."""
    assert atlas.yields is not None
    real, imaginary = np.split(atlas.yields, 2, axis=2)
    return np.asarray((real + 1j * imaginary)[:, :, None], np.complex128)


class FieldMap:
    """Evaluates the field of an atlas and its gradient at many positions; or of other nodes on its grid."""

    def __init__(self, atlas: Atlas, nodes: Complex | None = None) -> None:
        d = atlas.description
        nodes = complex_nodes(atlas) if nodes is None else nodes
        rows, columns = nodes.shape[:2]
        # A uniform cubic B-spline is centred on its node, two steps after its first knot.
        x_mm, y_mm = (
            start_mm + d.step_mm * (np.arange(count + 4) - 2)
            for start_mm, count in zip(d.origin_mm, (columns, rows), strict=True)
        )
        self._spline = NdBSpline((y_mm, x_mm), nodes.reshape(rows, columns, -1), 3)
        self._channels = nodes.shape[2]
        self.low_mm, self.high_mm = np.array(d.low_mm) - BEYOND_MM, np.array(d.high_mm) + BEYOND_MM

    def at(self, position_mm: Floats) -> Complex:
        """Return the field at positions (n, 2), shape (n, channels, bins)."""
        values = self._spline(np.ascontiguousarray(position_mm[:, ::-1]))
        return np.asarray(values.reshape(len(position_mm), self._channels, -1))

    def look_up(self, position_mm: Floats) -> tuple[Complex, Complex, Complex]:
        """Return the field at positions (n, 2) and its derivatives (1/mm), each of shape (n, channels * bins).

        The outermost cell extrapolates beyond the nodes.
        """
        at = np.ascontiguousarray(position_mm[:, ::-1])
        return self._spline(at), self._spline(at, nu=(0, 1)), self._spline(at, nu=(1, 0))


def place(atlas: Atlas, values: NDArray[np.complexfloating], start_mm: Floats, steps: int = 6) -> Placed:
    """Locate touches of shape (n, channels, bins), ADC counts, by Gauss-Newton steps from nearby positions (n, 2)."""
    field = FieldMap(atlas)
    flat: Complex = values.reshape(len(values), -1).astype(np.complex128)
    position_mm = start_mm.astype(np.float64)
    for _ in range(steps):
        _, _, gradient, fisher_information = linearise(flat, *field.look_up(position_mm))
        damped = fisher_information[:, 0] * (1 + _DAMPING * np.eye(2)) + 1e-30 * np.eye(2)
        move_mm = np.linalg.solve(damped, gradient[:, 0, :, None])[:, :, 0]
        length_mm = np.linalg.norm(move_mm, axis=1, keepdims=True)
        move_mm *= np.minimum(1.0, LONGEST_STEP_MM / np.maximum(length_mm, 1e-12))
        position_mm = np.clip(position_mm + move_mm, field.low_mm, field.high_mm)
    amplitude, residual_energy, _, fisher_information = linearise(flat, *field.look_up(position_mm))
    energy = np.square(np.abs(flat)).sum(axis=1)
    # Of a frame without a signal nothing is explained.
    misfit = np.where(energy > 0, residual_energy / np.maximum(energy, 1e-30), 1.0)
    return Placed(position_mm, amplitude, fisher_information[:, 0], misfit)
