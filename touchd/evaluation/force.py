"""Whether a contact's relative force follows the true one, whatever the place."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

FEWEST = 20
"""Contacts of known force, below which nothing can be said."""


def force_scores(force: ArrayLike, force_n: ArrayLike) -> dict[str, float | None]:
    """Return how well found forces of shape (m,) follow the true ones, NaN where either is unknown.

    `force_rank` is the rank correlation. A finger's contact area grows steadily with its true force, so it is that with
    the area as well. `force_spread` says how much the found force depends on anything else, such as the place: the RMS
    of force / f - 1, where f is the non-decreasing function of the true force, hence of the area, that fits best;
    `force_spread_p95` is what 95 % of the magnitudes stay below. None with fewer than `FEWEST` contacts.
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
    """Return Spearman's correlation of arrays of shape (m,), equals sharing their mean rank; None for a constant."""
    ranks = [_ranks(one), _ranks(other)]
    a, b = (rank - rank.mean() for rank in ranks)
    scale = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / scale if scale else None


def _ranks(value: Floats) -> Floats:
    _, place, count = np.unique(value, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(count) - (count - 1) / 2)[place])


def monotone(x: Floats, y: Floats) -> Floats:
    """Return the non-decreasing function of x that is nearest to y in least squares, at each x, shape (m,).

    Pool adjacent violators (Ayer et al., Ann. Math. Stat. 26:641, 1955): neighbours in the wrong order take their
    mean, weighted by how many they are. Equal x count as one.
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
