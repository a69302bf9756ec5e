"""Locate many touches on a field atlas at once, in float64: for calibration, and as reference of the daemon's path.

The method is that of `touchd.localization.gauss_newton` for one finger: eliminate the amplitude, then minimise the
unexplained energy over the position (variable projection, Golub and Pereyra 1973).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Atlas

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

LONGEST_STEP_MM = 3.0
BEYOND_MM = 3.0
"""Margin around the touched part in which a touch may be located."""
_DAMPING = 1e-3
_BLOCK = 256


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
    residual_energy: Floats
    """Unexplained energy, counts squared, shape (n,)."""
    energy: Floats
    """Energy of the touches, counts squared, shape (n,)."""

    @property
    def misfit(self) -> Floats:
        """Share of the energy that is unexplained, shape (n,)."""
        return self.residual_energy / np.maximum(self.energy, 1e-30)


class FieldMap:
    """Evaluates the field of an atlas and its gradient at many positions.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        d = atlas.description
        rows, columns, _ = atlas.coefficients.shape
        parts = atlas.coefficients.reshape(rows, columns, d.acquisition.channels, 2, len(d.bins))
        self._nodes = (parts[:, :, :, 0] + 1j * parts[:, :, :, 1]).reshape(rows, columns, -1)
        self._origin_mm, self._step_mm = np.array(d.origin_mm), d.step_mm
        self.low_mm, self.high_mm = np.array(d.low_mm) - BEYOND_MM, np.array(d.high_mm) + BEYOND_MM

    def look_up(self, position_mm: Floats) -> tuple[Complex, Complex, Complex]:
        """Return the field at positions (n, 2) and its derivatives (1/mm), each of shape (n, channels * bins).

        The outermost cell extrapolates beyond the nodes.
        """
        at = (position_mm - self._origin_mm) / self._step_mm
        most = np.array([self._nodes.shape[1] - 3, self._nodes.shape[0] - 3])
        corner = np.clip(np.floor(at).astype(int), 1, most)
        (wx, wy), (dx, dy) = (part.transpose(1, 0, 2) for part in _splines(at - corner))
        dx, dy = dx / self._step_mm, dy / self._step_mm
        near = np.arange(-1, 3)
        nodes = self._nodes[(corner[:, 1:] + near)[:, :, None], (corner[:, :1] + near)[:, None, :]]  # (n, 4, 4, m)
        along = np.einsum("nc,nrcm->nrm", wx, nodes)
        field = np.einsum("nr,nrm->nm", wy, along)
        by_y = np.einsum("nr,nrm->nm", dy, along)
        by_x = np.einsum("nr,nrm->nm", wy, np.einsum("nc,nrcm->nrm", dx, nodes))
        return field, by_x, by_y


def place(atlas: Atlas, values: NDArray[np.complexfloating], start_mm: Floats, steps: int = 6) -> Placed:
    """Locate touches by `steps` Gauss-Newton steps from nearby positions.

    Parameters
    ----------
    atlas : Atlas
    values : array, shape (n, channels, bins)
        Touches in the atlas' bins, ADC counts.
    start_mm : array, shape (n, 2)
    steps : int
    """
    field = FieldMap(atlas)
    blocks = range(0, len(values), _BLOCK)
    flat = values.reshape(len(values), -1).astype(np.complex128)
    done = [_place(field, flat[i : i + _BLOCK], start_mm[i : i + _BLOCK].astype(np.float64), steps) for i in blocks]
    return Placed(*(np.concatenate(parts) for parts in zip(*done, strict=True)))


def _place(
    field: FieldMap, values: Complex, position_mm: Floats, steps: int
) -> tuple[Floats, Complex, Floats, Floats, Floats]:
    for step in range(steps + 1):
        u, by_x, by_y = field.look_up(position_mm)
        power = np.maximum(np.square(np.abs(u)).sum(axis=1), 1e-30)
        amplitude = (u.conj() * values).sum(axis=1) / power
        left = values - amplitude[:, None] * u
        moved = amplitude[:, None, None] * np.stack([by_x, by_y], axis=1)
        moved -= ((moved @ u.conj()[:, :, None]) / power[:, None, None]) * u[:, None, :]
        fisher_information = (moved.conj() @ moved.transpose(0, 2, 1)).real
        if step == steps:
            break
        gradient = (moved.conj() @ left[:, :, None])[:, :, 0].real
        damped = fisher_information * (1 + _DAMPING * np.eye(2)) + 1e-30 * np.eye(2)
        move_mm = np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        length_mm = np.linalg.norm(move_mm, axis=1, keepdims=True)
        move_mm *= np.minimum(1.0, LONGEST_STEP_MM / np.maximum(length_mm, 1e-12))
        position_mm = np.clip(position_mm + move_mm, field.low_mm, field.high_mm)
    energy = np.square(np.abs(values)).sum(axis=1)
    return position_mm, amplitude, fisher_information, np.square(np.abs(left)).sum(axis=1), energy


def _splines(t: Floats) -> tuple[Floats, Floats]:
    """Return the four non-zero cubic B-splines at t in [0, 1) and their derivatives, as a last axis of 4."""
    value = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=-1) / 6
    slope = np.stack([-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2], axis=-1) / 2
    return value, slope
