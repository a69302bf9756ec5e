"""Which contacts are a palm's: one of several is larger than a thumb, and the others are within a hand's reach of it.

A palm that rolls onto the plate comes as one patch after the other, each like a finger. Once it is known, what lies
within its reach is the palm's, until nothing has been there for a while. Fingers farther away stay.
"""

from __future__ import annotations

import math

from touchd.localization.fit import Fit
from touchd.localization.spline import Position

LEAST_CONTACTS = 3
LARGE_MM2 = 4.2
"""Mean second moment over z: contacts of more than 175 mm^2. Thumbs of 160 mm^2 have 4.0 (twin)."""
REACH_MM = 60.0
"""From a palm's heel to the balls of the fingers."""
GONE_NS = 300_000_000


class Palm:
    """Remembers where a palm lies."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the palm."""
        self._place_mm: Position | None = None
        self._until_ns = 0

    def contacts(self, fit: Fit, t_ns: int) -> set[int]:
        """Return the indices of a fit's contacts that are a palm's."""
        if len(fit.shapes) >= LEAST_CONTACTS:
            moments = [
                abs(xx + yy) / 2 / max(abs(z), 1e-30)
                for z, (_, xx, yy, _) in zip(fit.amplitudes, fit.shapes, strict=True)
            ]
            if max(moments) > LARGE_MM2:
                self._place_mm, self._until_ns = fit.positions_mm[moments.index(max(moments))], t_ns + GONE_NS
        if self._place_mm is None:
            return set()
        if t_ns > self._until_ns:
            self.reset()
            return set()
        here = {k for k, place in enumerate(fit.positions_mm) if math.dist(place, self._place_mm) < REACH_MM}
        if here:
            self._until_ns = t_ns + GONE_NS
        return here
