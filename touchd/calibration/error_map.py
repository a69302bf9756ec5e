"""The expected error over the plate of the model that a fit with the taps so far makes.

It is the root of two variances:

- what all places have in common (ruler, clamped edge, wrong physics): as wide as the fit leaves it, less what the taps
  tell in the error of their own labels. It falls with each tap from the eighth on
- a touch's own: the Cramer-Rao bound in the plate's noise with the field's error, wrong physics included. The fit takes
  that to be alike everywhere; a tap measures it, near its place: it grows where the field is worse than the fit has it

It does not contain another temperature. A fit that may be good leaves its places as they are while taps tell them
little: its error then is that without taps. On simulated plates the median is 0.8 to 2.5 times that of touches; with
taps that have corrected the field itself it is up to a third too small.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from touchd.calibration.place_correction import Widths, label_scatter_mm, left_mm
from touchd.calibration.plan import bound_mm
from touchd.calibration.reduced_plate import Floats
from touchd.calibration.tap_fit import fit_taps
from touchd.calibration.taps import FITS, Taps, hits
from touchd.evaluation.dataset import BASELINE_NOISE
from touchd.localization.atlas import Atlas
from touchd.training.field.place import FieldMap

GRID = 20
"""Places along each side of the wizard's map."""
PRIOR_TAPS = 2.0
"""The model's own error counts as this many taps at each place."""
REACH = 0.2
"""Distance at which a tap counts for 0.6, as a share of the longer side."""
NOWHERE: Floats = np.empty((0, 2))
_TOP = 98
"""Percentile of the map without taps at which the colours end."""


class ErrorMap:
    """Maps the expected error of a light touch at `grid` places along each side of a fitted plate.

    `noise_counts` is the standard deviation of a sample's noise, ADC counts.
    """

    def __init__(self, atlas: Atlas, noise_counts: float, widths: Widths, grid: int = GRID) -> None:
        d = atlas.description
        self._atlas, self._widths = atlas, widths
        self._size_mm = d.plate.size_mm
        x_mm, y_mm = ((np.arange(grid) + 0.5) / grid * side for side in self._size_mm)
        self._places_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
        self._reach_mm = REACH * max(self._size_mm)
        self._bound_mm = bound_mm(*FieldMap(atlas).look_up(self._places_mm), 1.0)
        window = float(np.square(d.to_bins).sum()) / (2 * len(d.bins))
        self._noise = d.noise_scale * BASELINE_NOISE * noise_counts**2 * window
        self._own = d.field_scale * float(atlas.error.mean()) / 2
        self._shape = grid, grid
        fitted_mm = self.error_mm(None)
        self._fitted_mm, self._top_mm = float(np.median(fitted_mm)), float(np.percentile(fitted_mm, _TOP))

    def error_mm(self, taps: Taps | None) -> Floats:
        """Return the expected error after taps, shape (grid, grid), rows from the top."""
        if taps is None:
            return self.after()
        placed = fit_taps(self._atlas, taps.values, taps.label_mm)
        fits = placed.misfit < FITS
        if not fits.any():
            return self.after()
        placed_mm, label_mm = placed.position_mm[fits], taps.label_mm[fits]
        energy = np.square(np.abs(taps.values[fits])).sum(axis=(1, 2))
        left = placed.misfit[fits] * energy / (2 * taps.values[0].size * np.square(placed.size[fits]))
        apart_mm = np.linalg.norm(self._places_mm[:, None] - placed_mm, axis=2)
        near = np.exp(-np.square(apart_mm / self._reach_mm) / 2)
        measured = near @ (self._atlas.description.field_scale * left)
        field = (PRIOR_TAPS * self._own + measured) / (PRIOR_TAPS + near.sum(axis=1))
        hit = hits(placed_mm, label_mm)
        scatter_mm = label_scatter_mm(placed_mm[hit], label_mm[hit], self._size_mm, self._widths)
        return self.after(placed_mm[hit], scatter_mm, field)

    def after(self, placed_mm: Floats = NOWHERE, scatter_mm: float = 1.0, field: Floats | None = None) -> Floats:
        """Return the expected error after taps at `placed_mm` (n, 2), whose labels err by `scatter_mm` per axis.

        `field`, of shape (places,), is what the field has wrong at strength 1: by default what its atlas expects.
        """
        own_mm = self._bound_mm * np.sqrt(self._noise + (self._own if field is None else field))
        common_mm = left_mm(self._places_mm, placed_mm, scatter_mm, self._size_mm, self._widths)
        return np.hypot(own_mm, common_mm).reshape(self._shape)

    def shown(self, taps: Taps | None) -> dict[str, Any]:
        """Return the map for the page: rows of mm, its median, that without taps, and where the colours end."""
        error_mm = self.error_mm(taps)
        return {"mm": np.round(error_mm, 3).tolist(), "median_mm": round(float(np.median(error_mm)), 3),
                "fitted_mm": round(self._fitted_mm, 3), "top_mm": round(self._top_mm, 3)}  # fmt: skip
