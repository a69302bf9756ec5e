"""Predict each touch from all others, without a regression of its own for each.

With the weights a = C t of all touches, C the inverse system, the error of predicting touch i from all others is
a_i / C_ii (Rasmussen and Williams, Gaussian Processes for Machine Learning, eq. 5.12). The weights of the others are
a - C_i a_i / C_ii, so their field near touch i follows too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchd.training.field.regression import Array, Complex, Floats, Regression, each

_ROWS = 256


def left_out(regression: Regression, b: int, amplitude: Complex) -> Complex:
    """Return the error of predicting each touch of a bin from all others, shape (n, channels).

    Parameters
    ----------
    regression : Regression
    b : int
    amplitude : array, shape (n,)
    """
    inverse = regression.inverse(b, amplitude)
    weights = regression.apply(inverse, regression.targets(b, amplitude)).view(np.complex64)
    unit = weights / np.diag(inverse)[:, None]
    error: Complex = unit * amplitude[:, None] * np.float32(regression.scale[b])
    return error


@dataclass(frozen=True, slots=True)
class Displaced:
    """Displacements of touches from their assumed positions."""

    by_mm: Floats
    """Shape (n, 2)."""
    covariance: Floats
    """Covariance of `by_mm` due to noise and unexplained energy, shape (n, 2, 2), mm^2."""


def displacements(
    regression: Regression, amplitude: Complex, bins: NDArray[np.int64], inverses: list[Array]
) -> Displaced:
    """Locate each touch in the field of all others, by one Gauss-Newton step from its assumed position.

    Parameters
    ----------
    regression : Regression
    amplitude : array, shape (n, all bins)
    bins : array
        Bins to use.
    inverses : list of array
        Inverse system of each of these bins; only the lower triangles are read.
    """
    number = {int(b): i for i, b in enumerate(bins)}

    def one(b: int) -> Complex:
        field = predicted_by_others(regression, b, amplitude[:, b], inverses[number[b]])
        return np.asarray(field * amplitude[None, :, b, None] * np.float32(regression.scale[b]))

    field = np.stack(each(one, bins), axis=-1)  # (3, n, channels, bins)
    u, by_x, by_y = field.reshape(3, field.shape[1], -1).astype(np.complex128)
    values = regression.touches.values[:, :, bins].reshape(len(u), -1).astype(np.complex128)
    power = np.maximum(np.square(np.abs(u)).sum(axis=1), 1e-30)
    factor = (u.conj() * values).sum(axis=1) / power
    left = values - factor[:, None] * u
    moved = factor[:, None, None] * np.stack([by_x, by_y], axis=1)
    moved -= ((moved @ u.conj()[:, :, None]) / power[:, None, None]) * u[:, None, :]
    fisher_information = (moved.conj() @ moved.transpose(0, 2, 1)).real + 1e-30 * np.eye(2)
    gradient = (moved.conj() @ left[:, :, None])[:, :, 0].real
    by_mm = np.linalg.solve(fisher_information, gradient[:, :, None])[:, :, 0]
    unexplained = np.square(np.abs(left)).sum(axis=1) - np.einsum("ni,ni->n", gradient, by_mm)
    variance = np.maximum(unexplained, 1e-30) / max(2 * u.shape[1] - 4, 1)
    return Displaced(by_mm, np.linalg.inv(fisher_information) * variance[:, None, None])


def predicted_by_others(regression: Regression, b: int, amplitude: Complex, inverse: Array) -> Complex:
    """Predict the field at each touch from all others, and its derivatives with respect to x and y (1/mm).

    At amplitude 1, in units of the bin's scale, shape (3, n, channels).
    """
    targets = regression.targets(b, amplitude)
    weights = regression.apply(inverse, targets)
    diagonal = np.diag(inverse)
    own = weights / diagonal[:, None]
    full = np.tril(inverse) + np.tril(inverse, -1).T
    kernel, position_mm = regression.kernel(b), regression.touches.position_mm.astype(np.float32)
    found = np.empty((3, *targets.shape), np.float32)
    found[0] = targets - own
    for start in range(0, len(targets), _ROWS):
        rows = slice(start, start + _ROWS)
        slope = kernel.slope(regression.distance_mm[rows])
        for axis in (0, 1):
            part = slope * (position_mm[rows, None, axis] - position_mm[None, :, axis])
            found[1 + axis, rows] = part @ weights - (part * full[rows]).sum(axis=1)[:, None] * own[rows]
    return found.view(np.complex64)
