"""Statistics of position errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def position_scores(error_mm: ArrayLike) -> dict[str, float]:
    """Return the statistics of n position errors of shape (n, 2), mm.

    `rmse_mm` is sqrt(mean ||error||^2) (Bahrami et al. 2022); the others are statistics of ||error||.

    Raises
    ------
    ValueError
        n is 0.
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
