"""Statistics of the errors of positions, forces and faces."""

from __future__ import annotations

from math import nan

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.event import Contact
from touchd.touch import Touch
from touchd.tracking.face import Ellipse, ellipse_of

Floats = NDArray[np.float64]

FEWEST = 20
"""Least number of contacts of known force for a score."""
UNKNOWN = nan, nan, nan
LONG = 1.25
"""The direction of a rounder face is not scored."""


def position_scores(error_mm: ArrayLike) -> dict[str, float]:
    """Return the statistics of n position errors of shape (n, 2), mm.

    `rmse_mm` is sqrt(mean ||error||^2) (Bahrami et al. 2022); the others are statistics of ||error||. Raises ValueError
    if n is 0.
    """
    distance_mm = np.linalg.norm(np.asarray(error_mm, float).reshape(-1, 2), axis=1)
    if not len(distance_mm):
        raise ValueError("no position to score")
    return {
        "n": float(len(distance_mm)),
        "rmse_mm": float(np.sqrt(np.mean(distance_mm**2))),
        "mean_mm": float(distance_mm.mean()),
        "sd_mm": float(distance_mm.std()),
        "median_mm": float(np.median(distance_mm)),
        "p95_mm": float(np.percentile(distance_mm, 95)),
        "max_mm": float(distance_mm.max()),
    }


def force_scores(force: ArrayLike, force_n: ArrayLike) -> dict[str, float | None]:
    """Score estimated forces (m,) against true ones; NaN marks an unknown value.

    `force_rank` is Spearman's correlation. A finger's contact area grows monotonically with force, so it is also the
    correlation with the area. `force_spread` is the RMS of force / f - 1, where f is the best non-decreasing function
    of the true force: it measures how far the estimate depends on anything else, such as position. `force_spread_p95`
    is the 95th percentile of |force / f - 1|. With fewer than `FEWEST` contacts each score is None.
    """
    from scipy.stats import spearmanr  # with the extra `train`, as all of `touchd evaluate`; a replay needs none

    found, true = np.asarray(force, float), np.asarray(force_n, float)
    known = np.isfinite(found) & np.isfinite(true)
    found, true = found[known], true[known]
    if len(found) < FEWEST:
        return {"force_rank": None, "force_spread": None, "force_spread_p95": None}
    fitted = monotone(true, found)
    off = np.abs(found[fitted > 0] / fitted[fitted > 0] - 1)
    return {
        "force_rank": float(spearmanr(true, found).statistic) if np.ptp(true) and np.ptp(found) else None,
        "force_spread": float(np.sqrt(np.mean(off**2))) if len(off) else None,
        "force_spread_p95": float(np.percentile(off, 95)) if len(off) else None,
    }


def monotone(x: Floats, y: Floats) -> Floats:
    """Return the non-decreasing function of x nearest to y in least squares, at each x, shape (m,).

    Equal x count as one.
    """
    from scipy.optimize import isotonic_regression

    _, place, count = np.unique(x, return_inverse=True, return_counts=True)
    means = np.bincount(place, weights=y) / count
    return np.asarray(isotonic_regression(means, weights=count).x[place])


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
