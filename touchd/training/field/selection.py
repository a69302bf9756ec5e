"""Choose the field's prior by leave-one-out errors, on a part of the plate as dense as the whole."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from touchd.training.field.leave_one_out import displacements, left_out
from touchd.training.field.regression import Complex, Floats, Prior, Regression, Touches, each

REGION = 1200
"""Number of touches; the cost grows with its cube."""
FAR_MM = 1.5
"""Upper limit of a position error in the cost: a farther touch is in a wrong valley."""
INNER_SHARE = 0.88
"""Share of the region's sides; touches closer to its border lack neighbours and are ignored."""
RIDGES = (1e-4, 1e-3, 1e-2, 3e-2, 1e-1)
WHITE_SHARES = (0.01, 0.05, 0.15)


@dataclass(frozen=True, slots=True)
class Region:
    """Touches of a part of the plate."""

    at: NDArray[np.int64]
    """Indices among all touches, shape (n,)."""
    inner: NDArray[np.bool_]
    """Whether a touch has the same neighbours as on the whole plate, shape (n,)."""


def region_of(position_mm: Floats, count: int = REGION) -> Region:
    """Select `count` touches in a corner of the touched part.

    The field is hardest to predict near the plate's edges and discs, hence a corner.
    """
    low, high = position_mm.min(axis=0), position_mm.max(axis=0)
    off = ((position_mm - low) / np.maximum(high - low, 1e-9)).max(axis=1)
    at = np.sort(np.argsort(off, kind="stable")[:count])
    whole = len(at) == len(position_mm)
    return Region(at, np.ones(len(at), bool) if whole else off[at] <= INNER_SHARE * off[at].max())


def cut(touches: Touches, region: Region) -> Touches:
    """Select the touches of a region."""
    return Touches(touches.position_mm[region.at], touches.values[region.at], touches.noise)


def log_errors(
    touches: Touches, region: Region, prior: Prior, amplitude: Complex, bins: NDArray[np.int64]
) -> list[float]:
    """Return the log mean square error of predicting each touch from all others, for each of `bins`."""
    regression = Regression(touches, prior)

    def one(b: int) -> float:
        error = left_out(regression, b, amplitude[:, b])[region.inner]
        return float(np.log(np.square(np.abs(error)).mean()))

    return each(one, bins)


def choose(touches: Touches, prior: Prior, amplitude: Complex, bins: NDArray[np.int64]) -> Prior:
    """Choose the ridge and white share that minimise leave-one-out position errors.

    The cost uses positions, not values: an error common to many bins changes values little, but positions much.

    Parameters
    ----------
    touches : Touches
    prior : Prior
        Wavenumbers, and start of the search.
    amplitude : array, shape (n, bins)
    bins : array
        Bins to locate touches in.
    """
    region = region_of(touches.position_mm)
    some, mine = cut(touches, region), amplitude[region.at]

    def cost(candidate: Prior) -> float:
        regression = Regression(some, candidate)
        inverses = each(lambda b: regression.inverse(b, mine[:, b]), bins)
        off_mm = np.linalg.norm(displacements(regression, mine, bins, inverses).by_mm[region.inner], axis=1)
        return float(np.square(np.minimum(off_mm, FAR_MM)).mean())

    best = min((replace(prior, ridge=ridge) for ridge in RIDGES), key=cost)
    return min((replace(best, white_share=share) for share in WHITE_SHARES), key=cost)
