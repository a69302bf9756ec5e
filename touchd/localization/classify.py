"""Finger, water or departure? The phase of a fitted amplitude tells.

A finger has losses, a drop of water is a mass: its amplitude leads in phase. `lead` is that phase, rad.

====================================================  =======================================================
frame says                                            the contact becomes
====================================================  =======================================================
abs(lead) > 2.0                                       DEPARTURE: a finger that the baseline held has lifted
lead > 0.45, less 2.5 sigma of the phase              WATER
an amplitude below 0.5: lead > 0.5, less 1.5 sigma    WATER; remembered if lead > 0.5 by 2.5 sigma
the same where a finger was: lead > 0.5 by 1 sigma    WATER
lead > 0.15 within 3 mm of water of the last 10 s     WATER, unless the fit is clear (below); then DRYING
lead <= 0.15 there, where water lay for 0.1 s         DRYING, unless a finger has just come from beside it
DRYING for 30 ms                                      FINGER
anything else                                         FINGER
====================================================  =======================================================

Clear: one finger alone, confidence > 0.9, lead < 0.38 by 2 x 2.5 sigma.
"""

from __future__ import annotations

import cmath
import math
from enum import Enum
from typing import NamedTuple

from touchd.localization.atlas import Atlas
from touchd.localization.fit import Fit
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.noise import NoiseModel
from touchd.localization.position_error import PositionError
from touchd.localization.prediction import LONGEST_STEP_MM
from touchd.localization.spline import Position

LAG_RAD = -1.2
"""A finger lags by less. Human fingers lag by up to 0.4 rad (twin)."""
WATER_RAD = 0.45
"""Drops lead by about 0.6 rad, fingers by less than 0.3 (twin)."""
PHASE_SIGMAS = 2.5
"""A finger's phase stays below `WATER_RAD` by this many standard errors: the phase of a faint drop scatters."""
SMALL, SMALL_WATER_RAD = 0.5, 0.5
"""Contacts of few square millimetres are mass too: gloved fingers of 3 to 8 mm^2 lead by 0.28 to 0.47 rad, drops of as
small an amplitude by 0.51 to 0.68 (twin)."""
STILL_WATER_RAD, WATER_MM, WATER_NS = 0.15, 3.0, 10_000_000_000
"""Within 3 mm of water seen in the last 10 s, a smaller lead is water too: that of a faint drop, or of a drop while a
finger lands elsewhere, is ambiguous in single frames."""
SURE_NS = 100_000_000
"""Water that lay for 0.1 s stays water in single frames without any lead; before, it may have been a finger landing."""
DRY_RAD, DRY_NS, DRY_CONFIDENCE = 0.38, 30_000_000, 0.9
"""A lead below 0.38 rad in clear fits for 30 ms is a finger whose contact was small at first. On a transducer, whose
mass shifts both, light fingers lead by 0.15 to 0.36 and drops by 0.7 or more; elsewhere drops lead by 0.5 or more, and
by as little as 0.25 while fitted together with a strong finger (twin)."""
DEPARTURE_RAD = 2.0
"""An amplitude this far from a finger's has the opposite sign."""
MOST_WATER = 16
"""Drops remembered at most: more are a wet plate, on which nothing can be told apart."""
CORNER_MM = 12.0
"""Two fingers closer than this to one corner of the touched part are not placed: beyond it the field is not known, and
one finger there looks like two, one along either edge."""
EDGE_MM, WAVE_MM = 12.0, 30.0
"""A faint finger this near to an edge, with another within a wavelength, is not placed: the field is badly known there,
and one finger looks like two on either side of it, or with a second one beside it."""


class Substance(Enum):
    """What a fitted contact is."""

    FINGER = "finger"
    WATER = "water"
    DRYING = "drying"
    """Water that looks like a finger, not yet for long enough."""
    DEPARTURE = "departure"


class Drop(NamedTuple):
    """A place where water was seen."""

    position_mm: Position
    state: Substance
    """WATER or DRYING."""
    wet_since_ns: int
    dry_since_ns: int
    """Start of DRYING."""
    until_ns: int
    """The drop is forgotten at this time unless it is seen."""


Finger = tuple[Position, float, float]
"""A finger among the contacts of a fit: position, standard error (mm) and modulus of the amplitude."""


class Classifier:
    """Finds the fingers among the contacts of a fit, and remembers water.

    Parameters
    ----------
    atlas : Atlas
    noise : NoiseModel
    """

    def __init__(self, atlas: Atlas, noise: NoiseModel) -> None:
        self._noise = noise
        d = atlas.description
        self._errors = PositionError(atlas, noise)
        self._low_mm, self._high_mm = d.low_mm, d.high_mm
        self.departure = False
        """Whether the last fit shows the negative of fingers alone."""
        self.t_ns = 0
        """Time of the last frame."""
        self.reset()

    def reset(self) -> None:
        """Forget water and fingers."""
        self._drops: list[Drop] = []
        self._fingers: list[Position] = []

    def dry(self) -> None:
        """Forget water: the plate is untouched."""
        self._drops = []

    def fingers(self, fit: Fit, confidence: float, t_ns: int) -> list[Finger]:
        """Return the fingers among the contacts of a frame's fit, with their standard errors."""
        # Frames of a resting finger, which are not fitted, may have outlasted a drop. One without memory, which lasts
        # for the next fit, has the time of the last one.
        if self._drops:
            self._drops = [one for one in self._drops if one.until_ns > t_ns or one.until_ns == self.t_ns]
        self.t_ns = t_ns
        several = len(fit.positions_mm) > 1
        sizes, leads = list(map(abs, fit.amplitudes)), list(map(cmath.phase, fit.amplitudes))
        # The limits are those of points: on a transducer a shape turns the amplitude by up to 0.15 rad. The shape of a
        # small contact is little known, and so is its turn.
        for k, turn in enumerate(fit.turns):
            if sizes[k] >= SMALL:
                leads[k] = cmath.phase(fit.amplitudes[k] * turn)
        self.departure = min(map(abs, leads)) > DEPARTURE_RAD
        errors_mm = self._errors.sigmas_mm(fit, self._errors.variance(fit, sizes))
        doubtful = self._cornered(fit.positions_mm) | self._edged(fit) if several else ()
        fingers: list[Finger] = []
        drops: list[Drop] = []
        judged: list[Position] = []
        for k, position in enumerate(fit.positions_mm):
            drop = self._drop_at(position) if self._drops else None
            scatter = self._scatter_rad(fit.energies[k])
            small = sizes[k] < SMALL
            limit = self._small_limit_rad(position, scatter) if small else WATER_RAD - scatter
            lead = leads[k]
            if drop is None and LAG_RAD < lead < limit:  # the usual case
                judged.append(position)
                if k not in doubtful:
                    fingers.append((position, errors_mm[k], sizes[k]))
                continue
            substance = self._substance(lead, limit, scatter, drop, position, confidence, several=several)
            if substance is Substance.DEPARTURE:
                continue
            judged.append(position)
            if substance is not Substance.FINGER:
                if drop is not None or not small or lead > SMALL_WATER_RAD + scatter:
                    drops.append(self._drop(position, substance, drop))
            elif lead > LAG_RAD and k not in doubtful:
                fingers.append((position, errors_mm[k], sizes[k]))
        for one in self._drops:
            if one.until_ns > t_ns and all(math.dist(one.position_mm, position) >= WATER_MM for position in judged):
                drops.append(one)
        self._drops = drops[:MOST_WATER]
        self._fingers = [position for position, _, _ in fingers]
        return fingers

    def _substance(
        self,
        lead: float,
        limit: float,
        scatter: float,
        drop: Drop | None,
        position_mm: Position,
        confidence: float,
        *,
        several: bool,
    ) -> Substance:
        """Return what a contact is: the table of this module."""
        if abs(lead) > DEPARTURE_RAD:
            return Substance.DEPARTURE
        if lead >= limit:
            return Substance.WATER
        if drop is None:
            return Substance.FINGER
        if lead > STILL_WATER_RAD:
            # Beside another finger a drop's phase has a share of it.
            if several or lead + 2 * scatter >= DRY_RAD or confidence <= DRY_CONFIDENCE:
                return Substance.WATER
        elif self.t_ns - drop.wet_since_ns < SURE_NS or self._was_finger(position_mm, several=several):
            return Substance.FINGER
        dried = drop.state is Substance.DRYING and self.t_ns - drop.dry_since_ns >= DRY_NS
        return Substance.FINGER if dried else Substance.DRYING

    def _drop(self, position_mm: Position, state: Substance, before: Drop | None) -> Drop:
        """Return a drop as it now is."""
        goes_on = before is not None and before.state is Substance.DRYING and state is Substance.DRYING
        # A finger that lifts is like a drop in its last frames.
        memory_ns = 0 if self._was_finger(position_mm, several=True) else WATER_NS
        return Drop(
            position_mm,
            state,
            before.wet_since_ns if before else self.t_ns,
            before.dry_since_ns if before is not None and goes_on else self.t_ns,
            self.t_ns + memory_ns,
        )

    def _small_limit_rad(self, position_mm: Position, scatter: float) -> float:
        """Return the lead from which a small contact is water: one that was a finger stays one for longer."""
        sigma = scatter / PHASE_SIGMAS
        return SMALL_WATER_RAD + (sigma if self._was_finger(position_mm, several=True) else -1.5 * sigma)

    def _scatter_rad(self, energy: float) -> float:
        """Return `PHASE_SIGMAS` standard errors of the phase: the noise over the contact's energy is its variance."""
        return PHASE_SIGMAS * math.sqrt(self._noise.variance / energy) if energy > 0 else math.inf

    def _drop_at(self, position_mm: Position) -> Drop | None:
        """Return the drop near a position that was water last, or None. A drop stays where it is."""
        near = [one for one in self._drops if math.dist(one.position_mm, position_mm) < WATER_MM]
        return min(near, key=self._dryness_ns, default=None)

    def _dryness_ns(self, drop: Drop) -> int:
        return self.t_ns - drop.dry_since_ns if drop.state is Substance.DRYING else -1

    def _was_finger(self, position_mm: Position, *, several: bool) -> bool:
        """Return whether a finger of the last frame may have come to a position; of several fingers none comes far."""
        reach_mm = WATER_MM if several or len(self._fingers) > 1 else LONGEST_STEP_MM
        return any(math.dist(position_mm, finger) < reach_mm for finger in self._fingers)

    def _cornered(self, positions_mm: list[Position]) -> set[int]:
        """Return which of several fingers are, with another one, too near to one corner to be two."""
        (low_x, low_y), (high_x, high_y) = self._low_mm, self._high_mm
        found: set[int] = set()
        seen: dict[tuple[float, float], int] = {}
        for k, (x_mm, y_mm) in enumerate(positions_mm):
            corner = low_x if 2 * x_mm < low_x + high_x else high_x, low_y if 2 * y_mm < low_y + high_y else high_y
            if math.dist(corner, (x_mm, y_mm)) < CORNER_MM:
                found.update({seen[corner], k} if corner in seen else ())
                seen[corner] = k
        return found

    def _edged(self, fit: Fit) -> set[int]:
        """Return which of several fingers are faint, near an edge, and within a wavelength of another."""
        faint, places = CRITERIA.faint * self._noise.noise_energy, fit.positions_mm
        return {
            k
            for k, (energy, place) in enumerate(zip(fit.energies, places, strict=True))
            if energy < faint
            and any(
                at - low < EDGE_MM or high - at < EDGE_MM
                for at, low, high in zip(place, self._low_mm, self._high_mm, strict=True)
            )
            and any(math.dist(place, other) < WAVE_MM for j, other in enumerate(places) if j != k)
        }
