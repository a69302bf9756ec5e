"""When fingers are placed by the weighted fit, and how long that holds.

| fingers with shapes | are placed |
|---|---|
| of a frame judged alone, or that are new and step less than `SLOW_MM` | by the weighted fit |
| that have gone less than `HOLD_MM` since | as fitted, but for what the weighted fit moved them then |
| that move | as fitted |

A step of a finger that moves is longer than what the weighted fit would move it by, and the time is its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from touchd.localization.estimator import Finger
from touchd.localization.fit import Bins, Fit
from touchd.localization.spline import Position
from touchd.localization.weighted_fit import WeightedFit

SLOW_MM = 0.2
HOLD_MM = 1.0
"""A thirtieth of the wavelength: the field, and with it the model's error, is still much alike."""


class _Moved(NamedTuple):
    """What a weighted fit has moved a finger by."""

    from_mm: Position
    by_mm: Position
    share: float
    """Of the fit's standard error, what was left: a finger that lifts is less sure in each frame."""


class Refinement:
    """Places the fingers of one frame after the other.

    Parameters
    ----------
    weighted : WeightedFit
    """

    def __init__(self, weighted: WeightedFit) -> None:
        self._weighted = weighted
        self.reset()

    def reset(self) -> None:
        """Forget all fingers."""
        self._moved: Sequence[_Moved] = ()
        self._last_mm: Sequence[Position] = ()
        self.misfit = 0.0
        """Of the fingers, if they were placed by the weighted fit in the last frame; else 0."""

    def place(
        self, bins: Bins, fit: Fit, fingers: list[Finger], variance: float, *, new: bool, alone: bool
    ) -> tuple[list[Position], list[Finger]]:
        """Return where the contacts of a fit are, and the fingers among them with the standard errors of that.

        Parameters
        ----------
        bins : Bins
        fit : Fit
        fingers : list of Finger
            With the standard errors of the fit.
        variance : float
            Of the noise of a value, counts squared.
        new : bool
            Whether the shapes are this frame's.
        alone : bool
            Whether no further frame will be judged.
        """
        at, last, self._last_mm, self.misfit = fit.positions_mm, self._last_mm, fit.positions_mm, 0.0
        if not fit.shapes:
            self._moved = ()
        elif new or not self._holds(at):
            slow = len(last) == len(at) and max(map(math.dist, at, last)) < SLOW_MM
            self._moved = self._weigh(bins, fit, fingers, variance) if alone or slow else ()
        if not self._moved:
            return at, fingers
        moved = [(x + one.by_mm[0], y + one.by_mm[1]) for (x, y), one in zip(at, self._moved, strict=True)]
        return moved, [(k, self._moved[k].share * sigma_mm, size) for k, sigma_mm, size in fingers]

    def _holds(self, at: Sequence[Position]) -> bool:
        """Return whether the fingers are near where they were placed last."""
        return len(self._moved) == len(at) and all(
            math.dist(position, one.from_mm) < HOLD_MM for position, one in zip(at, self._moved, strict=True)
        )

    def _weigh(self, bins: Bins, fit: Fit, fingers: list[Finger], variance: float) -> Sequence[_Moved]:
        places, self.misfit = self._weighted.place(bins, fit, variance)
        sigmas_mm = {k: sigma_mm for k, sigma_mm, _ in fingers}
        return [
            _Moved((x, y), (place.x_mm - x, place.y_mm - y), place.sigma_mm / sigmas_mm.get(k, place.sigma_mm))
            for k, ((x, y), place) in enumerate(zip(fit.positions_mm, places, strict=False))
        ]
