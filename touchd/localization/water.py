"""Finger or water? A likelihood ratio of two contacts, summed over the frames of each.

A drop is a mass, its impedance i omega m. Tissue takes power from the plate: a piston of radius a on it lags a mass by
0.6 a / c, c the speed of sound in it, alike at all frequencies (Kinsler & Frey, Fundamentals of Acoustics). Its
amplitude grows as a^3, so a finger of amplitude A lags a mass by at least `TISSUE_RAD` A^(1/3), a drop by nothing.
`ratio` is the lag over that of a finger: 0 is water, 1 or more a finger.

=============  ===================  ===================================================================
contact        becomes              if the log likelihood ratio
=============  ===================  ===================================================================
undecided      finger, water        is above `SURE`, below -`SURE`
finger         water                is below -`SURE`
water          finger               is above `SURE` for 30 ms; at once within 0.1 s if the ratio is above 1
=============  ===================  ===================================================================
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from msgspec import Struct

from touchd.localization.spline import Position

MASS_LEAD_S = 1.47e-6
"""By which a mass leads a silicone tip of 20 mm^2, the middle of the training's (piston on a half-space)."""
TISSUE_RAD = 0.39
"""Lag behind a mass of a piston on soft tissue, at amplitude 1: gloves of 3 to 8 mm^2 lag by 0.16 to 0.26 rad (twin).
Slower or lossy tissue, as silicone and skin, lags by more."""
BIAS_RAD = 0.03
"""Standard deviation of what does not average out: the error of the field's phase, from place to place (twin)."""
SURE = 6.0
"""Log likelihood ratio: at most 1 drop in 400 is ever taken for a finger (Wald's bound)."""
SURE_ALONE = 2.5
"""The same of a frame that is judged alone: one look takes 1 drop in 400 for a finger (twin, 60 dB)."""
MEMORY = 4.0
"""Frames count until their noise has this part of the power of `BIAS_RAD`: more would tell nothing more."""
LAY_NS, DRY_NS = 100_000_000, 30_000_000
"""What leads for less than 0.1 s may be a finger that lands; of water one frame may say otherwise."""
NEAR_MM = 3.0
"""A drop stays where it is."""
WATER_NS, FINGER_NS = 10_000_000_000, 100_000_000
"""A contact is remembered for so long after it was seen."""
MOST = 16
"""Contacts remembered: more are a wet plate, on which nothing can be told apart."""


class Look(NamedTuple):
    """What one frame tells of a contact."""

    lag_rad: float
    """Behind a mass."""
    sigma_rad: float
    """Its standard error."""
    size: float
    """Modulus of the amplitude."""

    @property
    def finger_lag_rad(self) -> float:
        """Return the least lag of a finger of this amplitude."""
        return TISSUE_RAD * math.cbrt(max(self.size, 1e-6))

    def log_odds(self) -> float:
        """Return the log likelihood ratio of a finger over water."""
        own = self.finger_lag_rad
        return _log_odds(self.lag_rad / own, (self.sigma_rad**2 + BIAS_RAD**2) / own**2)


class State(Enum):
    """What a contact is."""

    UNDECIDED = "undecided"
    FINGER = "finger"
    WATER = "water"


class Evidence(Struct):
    """What the frames of one contact have told."""

    position_mm: Position
    until_ns: int = 0
    """When it is forgotten unless it is seen."""
    state: State = State.UNDECIDED
    ratio: float = 0.0
    """Weighted mean over the frames."""
    weight: float = 0.0
    """Of it: the inverse of its variance by noise."""
    since_ns: int = 0
    """When it became water."""
    likely_ns: int | None = None
    """Since when water has been likely to be a finger."""

    def update(self, position_mm: Position, look: Look, t_ns: int, sure: float = SURE) -> None:
        """Take the contact of a frame; `sure` is the ratio from which an undecided one is a finger."""
        own = look.finger_lag_rad
        bias2 = (BIAS_RAD / own) ** 2
        weight = (own / look.sigma_rad) ** 2 if look.sigma_rad > 0 else 1e12
        self.weight = min(self.weight, MEMORY / bias2) + weight
        self.ratio += weight / self.weight * (look.lag_rad / own - self.ratio) if weight > 0 else 0.0
        self.position_mm = position_mm
        self._decide(_log_odds(self.ratio, 1 / max(self.weight, 1e-12) + bias2), t_ns, sure)
        self.until_ns = t_ns + (FINGER_NS if self.state is State.FINGER else WATER_NS)

    def _decide(self, log_odds: float, t_ns: int, sure: float) -> None:
        if self.state is not State.WATER:
            if log_odds < -SURE:
                self.state, self.since_ns, self.likely_ns = State.WATER, t_ns, None
            elif log_odds > sure:
                self.state = State.FINGER
        elif log_odds <= SURE:
            self.likely_ns = None
        else:
            self.likely_ns = t_ns if self.likely_ns is None else self.likely_ns
            landed = self.ratio > 1 and self.likely_ns - self.since_ns < LAY_NS
            if landed or t_ns - self.likely_ns >= DRY_NS:
                self.state = State.FINGER


def _log_odds(ratio: float, variance: float) -> float:
    """Return the log likelihood ratio of a finger, which has a `ratio` of 1 or more, over water, which has 0."""
    return (ratio * ratio - min(ratio - 1, 0.0) ** 2) / (2 * variance)
