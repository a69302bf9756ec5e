"""Score how well a contact's relative force follows the true force, at any position."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FEWEST = 20
"""Least number of contacts of known force for a score."""


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


def monotone(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the non-decreasing function of x nearest to y in least squares, at each x, shape (m,).

    Equal x count as one.
    """
    from scipy.optimize import isotonic_regression

    _, place, count = np.unique(x, return_inverse=True, return_counts=True)
    means = np.bincount(place, weights=y) / count
    return np.asarray(isotonic_regression(means, weights=count).x[place])
