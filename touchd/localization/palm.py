"""Which contacts are a palm's: one of several is larger than a thumb, and the others are within a hand's reach of it.

A palm that rolls onto the plate comes as one patch after the other, each like a finger. Once it is known, what lies
within its reach is the palm's, until nothing has been there for a while. Fingers farther away stay.
"""

from __future__ import annotations

import math

from touchd.localization.contact_model import mean_moment_mm2
from touchd.localization.fit import Fit
from touchd.localization.spline import Position

LEAST_CONTACTS = 3
LARGE_MM2, LARGE_SIZE = 4.2, 2.0
"""Mean second moment over z: contacts of more than 175 mm^2. Thumbs of 160 mm^2 have 4.0 (twin). The amplitude of such
a contact is above 2.6 (twin); of faint ones, as of dry glass where a drop was learned, the shape is noise."""
REACH_MM = 60.0
"""From a palm's heel to the balls of the fingers."""
GONE_NS = 300_000_000
"""A palm is forgotten when no contact has been within its reach for so long."""


class Palm:
    """Remembers where a palm lies."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the palm."""
        self._place_mm: Position | None = None
        self._until_ns = 0

    def contacts(self, fit: Fit, t_ns: int) -> set[int]:
        """Return the indices of a fit's contacts that are a palm's, or water that lies within its reach."""
        if len(fit.shapes) >= LEAST_CONTACTS:
            moments_mm2 = [
                mean_moment_mm2(amplitude, shape) if abs(amplitude) > LARGE_SIZE else 0.0
                for amplitude, shape in zip(fit.amplitudes, fit.shapes, strict=True)
            ]
            largest_mm2 = max(moments_mm2)
            if largest_mm2 > LARGE_MM2:
                self._place_mm, self._until_ns = fit.positions_mm[moments_mm2.index(largest_mm2)], t_ns + GONE_NS
        if self._place_mm is None:
            return set()
        if t_ns > self._until_ns:
            self.reset()
            return set()
        return {k for k, place in enumerate(fit.positions_mm) if math.dist(place, self._place_mm) < REACH_MM}

    def see(self, t_ns: int) -> None:
        """Take a frame that shows a contact of the palm's which is not water: it lies there."""
        self._until_ns = t_ns + GONE_NS
