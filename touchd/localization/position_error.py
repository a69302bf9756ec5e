"""Standard error of a position: by noise, by the error of the field, by what a fit leaves, and by a shape left out.

===================  ==========================================================================================
error                variance per axis
===================  ==========================================================================================
noise                of the bins, over the Fisher information
field                that of half the touches, `TYPICAL` of the atlas' mean, over the same
unusual touch        `UNUSUAL` times what the fit leaves beyond that, over the same
shape left out       of a point: its bias at this place for `MOMENT_MM2`, squared
===================  ==========================================================================================

A soft tip that is fitted as a point leaves little of the signal, but its second-order field moves the position: of
silicone tips by 0.03 mm of the 0.05 that they err by (twin). How far, and what the field tells of a shape at all, are
tables over the atlas' nodes.
"""

from __future__ import annotations

import cmath
import math
from operator import mul
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Atlas
from touchd.localization.fit import Fit, sigmas_mm
from touchd.localization.noise import NoiseModel
from touchd.localization.spline import place_in_band

TYPICAL, TYPICAL_SHAPE, TYPICAL_SEVERAL = 0.4, 0.3, 0.5
"""Model error of half the touches, as a share of its mean, which is that of a few badly known places: of one point, of
one contact with a shape, whose five amplitudes take part of the error with them, and of several contacts, of which one
is at such a place more often (twin)."""
UNUSUAL = 14.0
"""Weight, relative to noise, of what a touch leaves beyond that: model error is alike in many bins. With it 68 and 95 %
of silicone and human fingers are within one and two standard errors at 40 to 80 dB (twin)."""
HIDDEN = 0.7
"""What half the fingertips leave, in the same unit: a shape's fit in noise that may hide as much leaves no less."""
MOMENT_MM2 = 0.2
"""Moment that a point may have unseen: 0 of a rigid tip, 0.2 to 0.5 of a soft one of silicone (twin)."""
PHASE_RAD = 0.4
"""Of a round face's second-order amplitudes over its amplitude, alike for all sizes."""
_STENCILS = np.array([[1, 4, 1], [-3, 0, 3], [6, -12, 6]]) / 6
"""Value and first two derivatives of a cubic B-spline at a node."""
_DERIVATIVES = ((1, 0), (0, 1), (0, 0), (2, 0), (0, 2), (1, 1))
"""Orders along x and y of u_x, u_y, u, u_xx, u_yy and u_xy."""
_UNKNOWNS = np.array([0, 1, 2, 9, 3, 10, 4, 11, 5, 12, 6, 13])
"""Of the fields of x, y, u, u along the band, u_xx, u_yy and u_xy, then of 1j times each: amplitudes have two parts."""
_TURN = cmath.rect(1.0, PHASE_RAD)


class PositionError:
    """Tells the standard errors of a fit's positions.

    Parameters
    ----------
    atlas : Atlas
    noise : NoiseModel
    """

    def __init__(self, atlas: Atlas, noise: NoiseModel) -> None:
        self._noise = noise
        self._field_scale: float = atlas.description.field_scale
        self._bias2 = shape_information(atlas).bias2

    def variance(self, fit: Fit, sizes: list[float]) -> float:
        """Return noise and model error of a value, counts squared; `sizes` are the moduli of the fit's amplitudes."""
        noise = self._noise
        missed: float = noise.mean_error * sum(map(mul, sizes, sizes)) / 2
        left = max(fit.residual_energy - noise.ceiling, 0.0) / noise.active_bins
        typical = TYPICAL if len(sizes) == 1 else TYPICAL_SEVERAL
        if len(fit.shapes) == 1:
            typical = TYPICAL_SHAPE
            left = max(left, min((noise.ceiling - noise.noise_energy) / noise.active_bins, HIDDEN * missed))
        unusual = UNUSUAL * max(left - typical * missed, 0.0)
        return noise.variance + TYPICAL * self._field_scale * missed + unusual

    def sigmas_mm(self, fit: Fit, variance: float) -> list[float]:
        """Return the standard error of each position per axis; `variance` is that of the fit."""
        sigmas = sigmas_mm(fit.fisher_information, variance)
        for k, share in enumerate(fit.shares):
            sigmas[k] *= share**-0.5
        if not fit.shapes:
            for k, (x_mm, y_mm) in enumerate(fit.positions_mm):
                sigmas[k] = math.sqrt(sigmas[k] ** 2 + MOMENT_MM2**2 * self._bias2.at(x_mm, y_mm))
        return sigmas


class NodeTable:
    """A number at each node of an atlas, and between them.

    Parameters
    ----------
    atlas : Atlas
    values : array of shape (rows, columns)
    """

    def __init__(self, atlas: Atlas, values: NDArray[np.float64]) -> None:
        self._x0_mm, self._y0_mm = map(float, atlas.description.origin_mm)
        self._per_mm = 1 / float(atlas.description.step_mm)
        rows, columns = values.shape
        self._last_x, self._last_y = float(columns) - 1.001, float(rows) - 1.001
        self._rows: list[list[float]] = values.tolist()

    def at(self, x_mm: float, y_mm: float) -> float:
        """Return the number at a position."""
        x = min(max((x_mm - self._x0_mm) * self._per_mm, 0.0), self._last_x)
        y = min(max((y_mm - self._y0_mm) * self._per_mm, 0.0), self._last_y)
        column, row = int(x), int(y)
        x -= column
        y -= row
        above, below = self._rows[row], self._rows[row + 1]
        return (1 - y) * ((1 - x) * above[column] + x * above[column + 1]) + y * (
            (1 - x) * below[column] + x * below[column + 1]
        )


class ShapeInformation(NamedTuple):
    """Tables for a contact of amplitude 1."""

    mean: NodeTable
    """Variance of the mean moment over z by noise of unit variance, mm^4 / counts^2."""
    oval: NodeTable
    """The same of half the moments' difference, and of the diagonal one."""
    bias2: NodeTable
    """Mean square per axis, mm^2, by which a point's position errs for 1 mm^2 of mean moment."""


_known: WeakKeyDictionary[Atlas, ShapeInformation] = WeakKeyDictionary()


def shape_information(atlas: Atlas) -> ShapeInformation:
    """Return the tables of an atlas; the quarter of a second that they take is spent once for each atlas."""
    if (known := _known.get(atlas)) is None:
        known = _known[atlas] = ShapeInformation(*(NodeTable(atlas, values) for values in _tables(atlas)))
    return known


def _tables(atlas: Atlas) -> NDArray[np.float64]:
    """Return the variances of both moments and the squared bias at every node, shape (3, rows, columns).

    An outermost node lacks a neighbour, and has the numbers of the next one. The first two numbers invert the Fisher
    information of x, y and the five amplitudes of one contact. Fingers nearby share their information; that is left
    out, as what the fit of several leaves is larger. The bias is that of omitted variables: where a fit of x, y and u
    alone moves to explain u_xx + u_yy.
    """
    # Unknowns: x, y, the parts of u, of u along the band, of a_xx, of a_yy and of a_xy.
    wanted = np.zeros((3, 12))
    wanted[0, -6:-2] = np.tile([_TURN.real / 2, _TURN.imag / 2], 2)
    wanted[1, [-6, -4]], wanted[2, -2] = (0.5, -0.5), 0.5
    inner = len(atlas.coefficients) - 2
    information = np.concatenate([_information(atlas, row) for row in range(1, inner + 1)])
    # A field of zeros, as of a plate without channels, tells nothing.
    empty = ~_regular(information)
    information[empty] = np.eye(12)
    spread = np.einsum("ki,nij,kj->kn", wanted, _inverse(information), wanted)
    spread[:, empty] = np.inf
    bias_mm = np.linalg.solve(information[:, :4, :4], 2 * information[:, :4] @ wanted[0, :, None])[:, :2, 0]
    found = np.stack([spread[0], spread[1:].mean(axis=0), np.square(bias_mm).mean(axis=1)])
    return np.pad(found.reshape(3, inner, -1), ((0, 0), (1, 1), (1, 1)), mode="edge")


def _information(atlas: Atlas, row: int) -> NDArray[np.float64]:
    """Return the Fisher information at each node of a row that has neighbours, shape (columns - 2, 12, 12)."""
    d, nodes = atlas.description, atlas.coefficients
    channels, bins = d.acquisition.channels, len(d.bins)
    along_y = np.tensordot(_STENCILS.astype(nodes.dtype), nodes[row - 1 : row + 2], 1)
    fields = np.empty((nodes.shape[1] - 2, 7, 2, channels, bins), nodes.dtype)  # u along the band is the fourth
    for k, (i, j) in zip((0, 1, 2, 4, 5, 6), _DERIVATIVES, strict=True):
        left, here, right = (_STENCILS[i] / d.step_mm ** (i + j)).astype(nodes.dtype)
        derivative = left * along_y[j, :-2] + here * along_y[j, 1:-1] + right * along_y[j, 2:]
        fields[:, k] = derivative.reshape(-1, channels, 2, bins).swapaxes(1, 2)
    fields[:, 3] = fields[:, 2] * place_in_band(atlas).astype(nodes.dtype).reshape(channels, bins)
    parts = fields.reshape(len(fields), 14, -1)
    products = (parts @ parts.swapaxes(1, 2)).astype(np.float64).reshape(-1, 7, 2, 7, 2)
    alike = products[:, :, 0, :, 0] + products[:, :, 1, :, 1]
    turned = products[:, :, 1, :, 0] - products[:, :, 0, :, 1]  # of one field with 1j times another
    every = np.block([[alike, turned], [-turned, alike]])
    return every[:, _UNKNOWNS[:, None], _UNKNOWNS]


def _inverse(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverses; of one that is singular but for rounding, what it cannot tell has a huge variance."""
    try:
        return np.asarray(np.linalg.inv(matrices), np.float64)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrices)
        least = np.finfo(np.float64).eps * values[:, -1:]
        return np.asarray((vectors / np.maximum(values, least)[:, None]) @ vectors.swapaxes(1, 2))


def _regular(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which positive semi-definite matrices can be inverted; where all can, it takes a tenth of the time."""
    try:
        np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.matrix_rank(matrices, hermitian=True) == matrices.shape[-1])
    return np.ones(len(matrices), dtype=np.bool_)
