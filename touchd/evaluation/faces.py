"""Score the sizes and directions of contacts."""

from __future__ import annotations

from math import nan

import numpy as np
from numpy.typing import NDArray

from touchd.event import Contact
from touchd.touch import Touch
from touchd.tracking.ellipse import Ellipse, ellipse_of

Floats = NDArray[np.float64]
UNKNOWN = nan, nan, nan
LONG = 1.25
"""The direction of a rounder face is not scored."""


def face_of(found: Touch | Contact) -> tuple[float, float, float]:
    """Return a contact's area (mm^2), long axis (mm) and direction (degrees), NaN of what is not told."""
    face: Contact | Ellipse | None
    face = found if isinstance(found, Contact) else ellipse_of(found.face) if found.face else None
    if face is None or face.area_mm2 is None or face.major_mm is None:
        return UNKNOWN
    return face.area_mm2, face.major_mm, nan if face.angle_deg is None else face.angle_deg


def face_scores(found: Floats, true: Floats) -> dict[str, float | None]:
    """Score faces (m, 3) as `face_of` returns them against long axis, short axis and direction (m, 3); NaN is unknown.

    =====================================  ========================================================================
    `faces_told`                           share of the contacts of known face whose size is told
    `area_median`, `area_p95`              relative error of the area
    `major_median_mm`, `major_p95_mm`      error of the long axis
    `angle_median_deg`, `angle_p95_deg`    error of the direction, of faces 1.25 times as long as wide or more
    =====================================  ========================================================================

    A score without data is None.
    """
    known = np.isfinite(true[:, 0])
    found, true = found[known], true[known]
    told = np.isfinite(found[:, 0])
    area = np.abs(found[:, 0] / (np.pi / 4 * true[:, 0] * true[:, 1]) - 1)[told]
    major_mm = np.abs(found[:, 1] - true[:, 0])[told]
    turn_deg = np.abs((found[:, 2] - true[:, 2] + 90) % 180 - 90)[true[:, 0] >= LONG * true[:, 1]]
    scores: dict[str, float | None] = {"faces_told": float(told.mean()) if len(told) else None}
    for name, unit, errors in (
        ("area", "", area), ("major", "_mm", major_mm), ("angle", "_deg", turn_deg[np.isfinite(turn_deg)])
    ):  # fmt: skip
        for score, percent in (("median", 50), ("p95", 95)):
            scores[f"{name}_{score}{unit}"] = float(np.percentile(errors, percent)) if len(errors) else None
    return scores
