"""What was fitted is a finger, water, or one that has gone: told by the phase of its strength, and how well known."""

from __future__ import annotations

import cmath
import math
from operator import mul
from typing import NamedTuple

from touchd.localization.atlas import Atlas
from touchd.localization.gauss_newton import Fit, sigmas_mm
from touchd.localization.noise import SPREAD, Hearing
from touchd.localization.prediction import LONGEST_STEP_MM
from touchd.localization.spline import Place
from touchd.touch import Touch

PHASE_RAD = (-1.2, 0.45)
"""Of a finger's strength. What leads by more has no loss: a mass, as a drop of water is. Drops lead by 0.6, fingers by
less than 0.3; human fingers lag by up to 0.4 (twin)."""
PHASE_SIGMAS = 2.5
"""So far within the upper bound a finger's phase has to be: that of a faint drop scatters, and it stays for hours."""
WET_RAD, WET_MM, WET_S = 0.15, 3.0, 10.0
"""What leads by so much may be a drop still, where one was seen so near, for so long since: of a faint one, or while a
finger comes down elsewhere, single frames say otherwise, or nothing."""
SURE_S = 0.1
"""So may what leads by less, where one was there for so long: a shorter time may have been a finger's own beginning."""
DRY_RAD, DRY_S, DRY_CONFIDENCE = 0.38, 0.03, 0.9
"""Nor is what has led by less than that for so long, in good fits: a finger whose contact was small at first. On a
transducer, whose own mass shifts both, light fingers lead by 0.15-0.36 and drops by 0.7 or more; elsewhere drops lead
by 0.5 or more, and by as little as 0.25 while they are fitted together with a strong finger (twin)."""
MOST_WET = 16
"""Places remembered at most: more would be a wet plate, on which nothing is told apart."""
CORNER_MM = 12.0
"""Beyond the touched part of the plate the field is not known; where that is so on two sides, a finger looks like two,
one along either edge. Two so near a corner of the touched part are not placed."""
LEAVING_RAD = 2.0
"""A strength so far from a finger's is one with the opposite sign: a finger that the baseline held has gone."""
TYPICAL = 0.5
"""Of what the field misses on average, that what it misses of half the touches: the mean is that of a few it knows
badly (twin)."""
WELL_KNOWN = 0.6
"""So much of the field's mean error moves a touch that leaves no more than is typical (twin, 40-70 dB)."""
UNUSUAL = 14.0
"""What a touch leaves beyond it counts so much more than noise: it is alike in many bins. Of silicone and human fingers
68 and 95 % are then within one and two standard errors (twin)."""


class _Wet(NamedTuple):
    """A place where a drop was seen."""

    place_mm: Place
    wet_s: float
    """For how long it has been there."""
    dry_s: float
    """For how long it has looked like a finger; below 0 if it did not in the last frame."""
    left_s: float
    """For how long it will be remembered if nothing is seen there."""

    def drying(self, elapsed_s: float) -> float:
        """Return for how long it looks like a finger if it does so long after the last frame."""
        return self.dry_s + elapsed_s if self.dry_s >= 0 else 0.0


_NOT_DRYING = -1.0


class Assessor:
    """Makes touches of fits.

    Parameters
    ----------
    atlas : Atlas
    hearing : Hearing
    """

    def __init__(self, atlas: Atlas, hearing: Hearing) -> None:
        self._hearing = hearing
        d = atlas.description
        self._field_scale = d.field_scale
        self._corners_mm = [(x, y) for x in (d.low_mm[0], d.high_mm[0]) for y in (d.low_mm[1], d.high_mm[1])]
        self._wet: list[_Wet] = []
        self._fingers: list[Touch] = []
        self.per_strength = 1.0
        """The change of the signal, as a share of its size, by a finger of strength 1."""
        self.leaving = False
        """Whether the fit assessed last shows the negative of fingers alone."""

    def forget(self) -> None:
        """Start afresh with the next frame."""
        self._wet, self._fingers = [], []

    def dry(self) -> None:
        """Take note that nothing is on the plate."""
        self._wet = []

    def touches(self, fit: Fit, confidence: float, elapsed_s: float) -> tuple[Touch, ...]:
        """Return the fingers of a fit, so long after the last, with their standard errors; what is water is none."""
        hearing = self._hearing
        variance, several = hearing.variance, len(fit.places_mm) > 1
        sizes, phases = list(map(abs, fit.strengths)), list(map(cmath.phase, fit.strengths))
        self.leaving = min(map(abs, phases)) > LEAVING_RAD
        missed = hearing.mean_error * sum(map(mul, sizes, sizes)) / 2
        left = max(fit.left - (1 + SPREAD) * hearing.expected, 0.0) / hearing.alive
        error = WELL_KNOWN * self._field_scale * missed + UNUSUAL * max(left - TYPICAL * missed, 0.0)
        errors_mm = sigmas_mm(fit.information, variance + error)
        cornered = self._cornered(fit.places_mm) if several else ()
        touches: list[Touch] = []
        wet: list[_Wet] = []
        judged: list[Place] = []
        for k, place in enumerate(fit.places_mm):
            phase, energy = phases[k], fit.energies[k]
            if abs(phase) > LEAVING_RAD:
                continue  # neither a finger nor water
            judged.append(place)
            # The noise over a finger's energy is the variance of its phase.
            scatter = PHASE_SIGMAS * math.sqrt(variance / energy) if energy > 0 else math.inf
            drop = self._drop_at(place) if self._wet else None
            dry_s = math.inf
            if phase >= PHASE_RAD[1] - scatter:
                dry_s = _NOT_DRYING
            elif drop is not None and phase > WET_RAD:
                # Beyond doubt; and not beside another finger, from which a drop's phase has a share.
                doubtful = several or phase + 2 * scatter >= DRY_RAD or confidence <= DRY_CONFIDENCE
                dry_s = _NOT_DRYING if doubtful else drop.drying(elapsed_s)
            elif drop is not None and drop.wet_s >= SURE_S and not self._was_finger(place, several=several):
                dry_s = drop.drying(elapsed_s)
            if dry_s < DRY_S:
                # A finger that lifts is like a drop in its last frames.
                left_s = 0.0 if self._was_finger(place, several=True) else WET_S
                wet.append(_Wet(place, drop.wet_s + elapsed_s if drop else 0.0, dry_s, left_s))
            elif phase > PHASE_RAD[0] and k not in cornered:
                touches.append(Touch(*place, errors_mm[k], confidence, sizes[k] * self.per_strength))
        for one in self._wet:
            if one.left_s > elapsed_s and all(math.dist(one.place_mm, place) >= WET_MM for place in judged):
                wet.append(one._replace(left_s=one.left_s - elapsed_s))
        self._wet = wet[:MOST_WET]
        self._fingers = touches
        return tuple(touches)

    def _drop_at(self, place_mm: Place) -> _Wet | None:
        """Return the drop that was seen near a place, and was one last; None if there was none.

        A drop stays where it is: where one was seen, what is like a finger in a single frame still is one.
        """
        near = [one for one in self._wet if math.dist(one.place_mm, place_mm) < WET_MM]
        return min(near, key=lambda one: one.dry_s, default=None)

    def _was_finger(self, place_mm: Place, *, several: bool) -> bool:
        """Return whether a finger of the last frame may have come to a place; of several fingers none comes far."""
        reach_mm = WET_MM if several or len(self._fingers) > 1 else LONGEST_STEP_MM
        return any(math.dist(place_mm, (one.x_mm, one.y_mm)) < reach_mm for one in self._fingers)

    def _cornered(self, places_mm: list[Place]) -> set[int]:
        """Return which of several fingers are, with another one, too near to one corner to be two."""
        found: set[int] = set()
        for x, y in self._corners_mm:
            near = [k for k, (x_mm, y_mm) in enumerate(places_mm) if math.hypot(x_mm - x, y_mm - y) < CORNER_MM]
            if len(near) > 1:
                found.update(near)
        return found
