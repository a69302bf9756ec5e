"""What a field's prior should be: chosen by how well it foretells and places touches that are left out.

It is done on the touches of a part of the plate, as dense as all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from touchd.training.field.leave_one_out import displacements, left_out
from touchd.training.field.regression import Complex, Floats, Prior, Regression, Touches, each

REGION = 1200
"""Touches: the cube of them is what it costs."""
FAR_MM = 1.5
"""A touch placed farther off counts as if it were so far: it found a wrong valley."""
INNER_SHARE = 0.88
"""Of the region's sides: touches closer to its border lack neighbours, and do not count."""
RIDGES = (1e-4, 1e-3, 1e-2, 3e-2, 1e-1)
WHITE_SHARES = (0.01, 0.05, 0.15)


@dataclass(frozen=True, slots=True)
class Region:
    """Touches of a part of the plate."""

    at: NDArray[np.int64]
    """Their indices among all touches, shape (n,)."""
    inner: NDArray[np.bool_]
    """Which of them have all the neighbours that they have on the whole plate, shape (n,)."""


def region_of(place_mm: Floats, count: int = REGION) -> Region:
    """Return the touches of a corner of the touched part, as large as holds so many.

    A corner, since the field is hardest to foretell near the plate's edges and discs.
    """
    low, high = place_mm.min(axis=0), place_mm.max(axis=0)
    off = ((place_mm - low) / np.maximum(high - low, 1e-9)).max(axis=1)
    at = np.sort(np.argsort(off, kind="stable")[:count])
    whole = len(at) == len(place_mm)
    return Region(at, np.ones(len(at), bool) if whole else off[at] <= INNER_SHARE * off[at].max())


def cut(touches: Touches, region: Region) -> Touches:
    """Return the touches of a region."""
    return Touches(touches.place_mm[region.at], touches.values[region.at], touches.noise)


def surprises(
    touches: Touches, region: Region, prior: Prior, strength: Complex, bins: NDArray[np.int64]
) -> list[float]:
    """Return how badly a prior foretells touches that are left out: log mean square error in each of some bins."""
    regression = Regression(touches, prior)

    def one(b: int) -> float:
        error = left_out(regression, b, strength[:, b])[region.inner]
        return float(np.log(np.square(np.abs(error)).mean()))

    return each(one, bins)


def choose(touches: Touches, prior: Prior, strength: Complex, bins: NDArray[np.int64]) -> Prior:
    """Return the prior with the ridge and the white share under which touches that are left out are placed best.

    By their places and not by their values: an error that is common to many bins costs little of the one, but much
    of the other.

    Parameters
    ----------
    touches : Touches
    prior : Prior
        Holds the wavenumbers; the rest is where to start.
    strength : array, shape (n, bins)
    bins : array
        In which to place them.
    """
    region = region_of(touches.place_mm)
    some, mine = cut(touches, region), strength[region.at]

    def cost(candidate: Prior) -> float:
        regression = Regression(some, candidate)
        inverses = each(lambda b: regression.inverse(b, mine[:, b]), bins)
        off_mm = np.linalg.norm(displacements(regression, mine, bins, inverses).by_mm[region.inner], axis=1)
        return float(np.square(np.minimum(off_mm, FAR_MM)).mean())

    best = min((replace(prior, ridge=ridge) for ridge in RIDGES), key=cost)
    return min((replace(best, white_share=share) for share in WHITE_SHARES), key=cost)
