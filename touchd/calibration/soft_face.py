"""Spread a field over a fingertip's face, where waves are about as short as it is wide.

A contact's field is that of a small one with second derivatives beside it (`touchd.localization.contact_model`). Where
a finger is nearly as wide as the wave is long, these are a poor start: soft tissue follows the wave, so that its field
is the mean of the small contact's over its face, and faces differ by little from each other. On acrylic at 50 to 100
kHz waves of 11 mm leave of a fingertip, with all amplitudes fitted, 3.3 % of the energy beside a small contact's field
and 0.7 % beside this one; a silicone tip 0.2 and 0.4 % (twin).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from touchd.calibration.parameters import wavelength_mm
from touchd.calibration.plate_fit import PlateFit
from touchd.calibration.reduced_plate import Floats
from touchd.calibration.spline_grid import Grid, grid_of, spline_values
from touchd.localization.atlas import Atlas

SHORT_MM = 17.0
"""Of shorter waves a finger's face is a large part. Fingertips and thumbs are placed better with the wide contact on 2
and 3 mm of glass and on 5 and 8 mm of acrylic, silicone tips worse; with waves of 15.6 mm 97 of 100 thumbs instead of
63 have the right number, with 18.6 mm all have it either way (twin)."""
FACE_MM = 1.8
"""Standard deviation of the mean's weights along x and y: half the radius of a finger of 41 mm^2. Of 1 to 3 mm this is
about the width at which the worst of child, fingertip and silicone tip leaves least (twin)."""
_NODE, _WEIGHT = np.polynomial.hermite_e.hermegauss(5)


def for_fingers(atlas: Atlas, fit: PlateFit) -> Atlas:
    """Return a fitted plate's atlas, spread where waves are shorter than `SHORT_MM`."""
    return spread(atlas) if wavelength_mm(fit.plate, fit.acquisition.chirp) < SHORT_MM else atlas


def spread(atlas: Atlas) -> Atlas:
    """Return a physical atlas with the field of a contact as wide as a finger; near an edge as the plate admits."""
    d = atlas.description
    across, down = (_spreading(grid_of(side, d.step_mm), side, d.step_mm) for side in d.plate.size_mm)
    rows = np.tensordot(down, np.tensordot(across, atlas.coefficients, (1, 1)), (1, 1))
    coefficients = np.ascontiguousarray(rows, atlas.coefficients.dtype)
    # The error is a share of the field's energy.
    by_bin = d.acquisition.channels, 2, len(d.bins)
    before, after = (
        np.square(each).mean(axis=(0, 1)).reshape(by_bin).sum(axis=1) for each in (atlas.coefficients, coefficients)
    )
    error = (atlas.error * after / before).astype(atlas.error.dtype)
    return replace(atlas, coefficients=coefficients, error=error, description=d.model_copy(update={"face_mm": FACE_MM}))


def _spreading(grid: Grid, length_mm: float, step_mm: float) -> Floats:
    """Return the matrix from an axis' coefficients to those of its field's mean, shape (nodes, nodes)."""
    at = grid.samples_mm
    width_mm = np.minimum(FACE_MM, np.minimum(at, length_mm - at) / _NODE[-1])
    around = at[:, None] + width_mm[:, None] * _NODE  # (samples, 5)
    mean = spline_values(around, grid.nodes_mm, step_mm).swapaxes(1, 2) @ (_WEIGHT / _WEIGHT.sum())
    return np.asarray(grid.solve @ mean)
