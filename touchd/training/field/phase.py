"""One phase for a finger everywhere on the plate.

Only the products of strengths and field are seen, so that the field's phase at each place is a matter of choice.
The learning keeps it smooth; but where a transducer loads the plate a finger's strength is half a radian ahead,
as that of a drop of water is elsewhere. With the field turned by the mean phase of the touches around each
place, a finger has the same phase all over the plate, and water can be told from it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Atlas

REACH_MM = 4.0
"""Deviation of the weights of touches around a place: a transducer is 6 mm wide."""
_ASSUMED = 0.5
"""Touches of phase 0 that are added to each place, for where there are none."""
_ROWS = 512


def aligned(atlas: Atlas, place_mm: NDArray[np.float64], strength: NDArray[np.complex128]) -> Atlas:
    """Return an atlas whose touches at (n, 2) mm, of strengths (n,) so far, all have a phase of about 0."""
    d = atlas.description
    rows, columns, _ = atlas.coefficients.shape
    x_mm = d.origin_mm[0] + d.step_mm * np.arange(columns)
    y_mm = d.origin_mm[1] + d.step_mm * np.arange(rows)
    nodes_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    turn = np.exp(1j * np.angle(mean_direction(nodes_mm, place_mm, strength))).reshape(rows, columns, 1, 1)
    parts = atlas.coefficients.reshape(rows, columns, d.acquisition.channels, 2, len(d.bins))
    turned = (parts[:, :, :, 0] + 1j * parts[:, :, :, 1]) * turn
    coefficients = np.stack([turned.real, turned.imag], axis=3).reshape(atlas.coefficients.shape)
    return replace(atlas, coefficients=np.ascontiguousarray(coefficients, np.float32))


def mean_direction(
    at_mm: NDArray[np.float64], place_mm: NDArray[np.float64], strength: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Return the weighted mean of the strengths' directions around places (m, 2), shape (m,)."""
    direction = strength / np.maximum(np.abs(strength), 1e-12)
    mean = np.empty(len(at_mm), np.complex128)
    for start in range(0, len(at_mm), _ROWS):
        off_mm2 = np.square(at_mm[start : start + _ROWS, None] - place_mm[None]).sum(axis=2)
        weight = np.exp(-off_mm2 / (2 * REACH_MM**2))
        mean[start : start + _ROWS] = (weight @ direction + _ASSUMED) / (weight.sum(axis=1) + _ASSUMED)
    return mean
