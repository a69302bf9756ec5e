"""Align the phase of a finger over the whole plate.

Only the product of amplitude and field is observable, so the field's phase at each position is arbitrary. Learning
keeps it smooth; but where a transducer loads the plate, a finger leads by half a radian, as water does elsewhere.
Turning the field by the mean phase of nearby touches gives a finger one phase everywhere, so that water can be
distinguished.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Atlas

REACH_MM = 4.0
"""Standard deviation of the spatial weights; a transducer is 6 mm wide."""
_ASSUMED = 0.5
"""Weight of an assumed touch of phase 0 at each position, for areas without touches."""
_ROWS = 512


def aligned(atlas: Atlas, position_mm: NDArray[np.float64], amplitude: NDArray[np.complex128]) -> Atlas:
    """Return an atlas in which touches at (n, 2) mm, of current amplitudes (n,), have a phase near 0."""
    d = atlas.description
    rows, columns, _ = atlas.coefficients.shape
    x_mm = d.origin_mm[0] + d.step_mm * np.arange(columns)
    y_mm = d.origin_mm[1] + d.step_mm * np.arange(rows)
    nodes_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    turn = np.exp(1j * np.angle(mean_direction(nodes_mm, position_mm, amplitude))).reshape(rows, columns, 1, 1)
    parts = atlas.coefficients.reshape(rows, columns, d.acquisition.channels, 2, len(d.bins))
    turned = (parts[:, :, :, 0] + 1j * parts[:, :, :, 1]) * turn
    coefficients = np.stack([turned.real, turned.imag], axis=3).reshape(atlas.coefficients.shape)
    return replace(atlas, coefficients=np.ascontiguousarray(coefficients, np.float32))


def mean_direction(
    at_mm: NDArray[np.float64], position_mm: NDArray[np.float64], amplitude: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Return the weighted mean direction of the amplitudes around positions (m, 2), shape (m,)."""
    direction = amplitude / np.maximum(np.abs(amplitude), 1e-12)
    mean = np.empty(len(at_mm), np.complex128)
    for start in range(0, len(at_mm), _ROWS):
        off_mm2 = np.square(at_mm[start : start + _ROWS, None] - position_mm[None]).sum(axis=2)
        weight = np.exp(-off_mm2 / (2 * REACH_MM**2))
        mean[start : start + _ROWS] = (weight @ direction + _ASSUMED) / (weight.sum(axis=1) + _ASSUMED)
    return mean
