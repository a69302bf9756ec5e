"""Score how well a contact's relative force follows the true force, at any position."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

FEWEST = 20
"""Least number of contacts of known force for a score."""


def force_scores(force: ArrayLike, force_n: ArrayLike) -> dict[str, float | None]:
    """Score estimated forces (m,) against true ones; NaN marks an unknown value.

    `force_rank` is Spearman's correlation. A finger's contact area grows monotonically with force, so it is also the
    correlation with the area. `force_spread` is the RMS of force / f - 1, where f is the best non-decreasing function
    of the true force: it measures how far the estimate depends on anything else, such as position. `force_spread_p95`
    is the 95th percentile of |force / f - 1|. With fewer than `FEWEST` contacts each score is None.
    """
    found, true = np.asarray(force, float), np.asarray(force_n, float)
    known = np.isfinite(found) & np.isfinite(true)
    found, true = found[known], true[known]
    if len(found) < FEWEST:
        return {"force_rank": None, "force_spread": None, "force_spread_p95": None}
    fitted = monotone(true, found)
    off = np.abs(found[fitted > 0] / fitted[fitted > 0] - 1)
    return {
        "force_rank": rank_correlation(true, found),
        "force_spread": float(np.sqrt(np.mean(off**2))) if len(off) else None,
        "force_spread_p95": float(np.percentile(off, 95)) if len(off) else None,
    }


def rank_correlation(one: Floats, other: Floats) -> float | None:
    """Return Spearman's correlation of arrays of shape (m,), with mean ranks for ties; None for a constant."""
    ranks = [_ranks(one), _ranks(other)]
    a, b = (rank - rank.mean() for rank in ranks)
    scale = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / scale if scale else None


def _ranks(value: Floats) -> Floats:
    _, place, count = np.unique(value, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(count) - (count - 1) / 2)[place])


def monotone(x: Floats, y: Floats) -> Floats:
    """Return the non-decreasing function of x nearest to y in least squares, at each x, shape (m,).

    Pool adjacent violators (Ayer et al., Ann. Math. Stat. 26:641, 1955): neighbours in the wrong order take their
    weighted mean. Equal x count as one.
    """
    _, place, count = np.unique(x, return_inverse=True, return_counts=True)
    means = np.bincount(place, weights=y) / count
    level: list[float] = []
    weight: list[int] = []
    width: list[int] = []
    for value, many in zip(means.tolist(), count.tolist(), strict=True):
        level.append(value)
        weight.append(many)
        width.append(1)
        while len(level) > 1 and level[-2] >= level[-1]:
            total = weight[-2] + weight[-1]
            level[-2:] = [(level[-2] * weight[-2] + level[-1] * weight[-1]) / total]
            weight[-2:], width[-2:] = [total], [width[-2] + width[-1]]
    return np.asarray(np.repeat(level, width)[place])
