"""The expected error over the plate, where taps correct what the model says of itself.

The report's map takes the field's own error to be as the fitted plate has it, everywhere. A tap measures it: what the
field leaves of the tap. Near taps their error counts, far from all the model's own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.plan import bound_mm
from touchd.calibration.taps import FITS, Taps
from touchd.evaluation.dataset import BASELINE_NOISE
from touchd.localization.atlas import Atlas
from touchd.recording.format import read
from touchd.training.field.place import FieldMap, place

Floats = NDArray[np.float64]

GRID = 20
"""Places along each side of the map."""
PRIOR_TAPS = 2.0
"""The model's own error counts as this many taps at each place."""
REACH = 0.2
"""Distance at which a tap counts for 0.6, as a share of the longer side."""
_TOP = 98
"""Percentile of the map without taps at which the colours end."""


class ErrorMap:
    """Maps the expected error of a light touch.

    Parameters
    ----------
    atlas : Atlas
        The fitted field.
    reference : Path
        Untouched frames, which tell the noise.
    """

    def __init__(self, atlas: Atlas, reference: Path) -> None:
        d = atlas.description
        self._atlas = atlas
        sides = d.plate.width_mm, d.plate.height_mm
        x_mm, y_mm = ((np.arange(GRID) + 0.5) / GRID * side for side in sides)
        self._places_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
        self._reach_mm = REACH * max(sides)
        self._bound_mm = bound_mm(*FieldMap(atlas).look_up(self._places_mm), 1.0)
        noise2 = float(read(reference).frames.var(axis=0, ddof=1, dtype=np.float64).mean())
        window = float(np.square(d.to_bins).sum()) / (2 * len(d.bins))
        self._noise = d.noise_scale * BASELINE_NOISE * noise2 * window
        self._own = d.field_scale * float(atlas.error.mean()) / 2
        self._top_mm = float(np.percentile(self.error_mm(None), _TOP))

    def error_mm(self, taps: Taps | None) -> Floats:
        """Return the expected error, shape (GRID, GRID), rows from the top."""
        field = np.full(len(self._places_mm), self._own)
        if taps is not None:
            placed = place(self._atlas, taps.values, taps.label_mm)
            fits = placed.misfit < FITS
            energy = np.square(np.abs(taps.values[fits])).sum(axis=(1, 2))
            left = placed.misfit[fits] * energy / (2 * taps.values[0].size * np.square(np.abs(placed.amplitude[fits])))
            apart_mm = np.linalg.norm(self._places_mm[:, None] - placed.position_mm[fits], axis=2)
            near = np.exp(-np.square(apart_mm / self._reach_mm) / 2)
            measured = near @ (self._atlas.description.field_scale * left)
            field = (PRIOR_TAPS * self._own + measured) / (PRIOR_TAPS + near.sum(axis=1))
        return (self._bound_mm * np.sqrt(self._noise + field)).reshape(GRID, GRID)

    def shown(self, taps: Taps | None) -> dict[str, Any]:
        """Return the map for the page: rows of mm, their median, and where the colours end."""
        error_mm = self.error_mm(taps)
        return {"mm": np.round(error_mm, 3).tolist(), "median_mm": round(float(np.median(error_mm)), 3),
                "top_mm": round(self._top_mm, 3)}  # fmt: skip
