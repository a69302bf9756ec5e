"""Finger, water or departure? The phase of a fitted amplitude tells.

A finger has losses, a drop of water is a mass: its amplitude leads in phase. `lead` is that phase, rad.

=============================================  ==============================================
frame says                                     the contact becomes
=============================================  ==============================================
abs(lead) > 2.0                                DEPARTURE: a finger that the baseline held has lifted
amplitude above 0.5, lead < 0.3 by 4 sigma     finger, unless water was seen there (0.3 at 67.5 kHz)
anything else                                  finger, water or undecided, by `water.Evidence`
=============================================  ==============================================
"""

from __future__ import annotations

import cmath
import math
from operator import mul

from touchd.localization.atlas import Atlas
from touchd.localization.estimator import Finger
from touchd.localization.feet import Feet
from touchd.localization.fit import Bins, Fit
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.following import LONGEST_STEP_MM
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.noise import NoiseModel
from touchd.localization.palm import Palm
from touchd.localization.position_error import PositionError
from touchd.localization.spline import Position
from touchd.localization.water import (
    MOST,
    MOST_REACH_MM,
    NEAR_MM,
    REACH_SIGMAS,
    SURE,
    SURE_ALONE,
    USUAL_HZ,
    Evidence,
    Look,
    MassPhase,
    State,
    mean_hz,
)

LAG_RAD = -1.2
"""A finger lags by less. Human fingers lag by up to 0.4 rad (twin)."""
CLEAR_RAD, CLEAR_SIZE, CLEAR_SIGMAS = 0.3, 0.5, 4.0
"""Drops of such an amplitude lead by 0.45 rad or more at `USUAL_HZ` (twin)."""
MOST_SIZE = 1.0
"""On waves about as short as a finger is wide the plate is light, and its own yield limits by how much a large contact
lags: it need not lag by more than one of this amplitude."""
DEPARTURE_RAD = 2.0
"""An amplitude this far from a finger's has the opposite sign."""
CORNER_MM = 12.0
"""Two fingers closer than this to one corner of the touched part are not placed: beyond it the field is not known, and
one finger there looks like two, one along either edge."""
LACKING = 0.5
"""Of what a fit leaves, as an amplitude, this share may be along a contact's own: a drop that lacked turned another by
0.3 rad (twin)."""
EDGE_MM, WAVE_MM = 12.0, 30.0
"""A faint finger this near to an edge, with another within a wavelength, is not placed: the field is badly known there,
and one finger looks like two on either side of it, or with a second one beside it."""


class Classifier:
    """Finds the fingers among the contacts of a fit, and remembers water.

    Parameters
    ----------
    atlas : Atlas
    noise : NoiseModel
    solver : GaussNewton
    feet : Feet
    """

    def __init__(self, atlas: Atlas, noise: NoiseModel, solver: GaussNewton, feet: Feet) -> None:
        self._noise, self._feet, self._phase = noise, feet, MassPhase(atlas, solver, noise)
        d = atlas.description
        self._errors, self.palm = PositionError(atlas, noise), Palm()
        self._low_mm, self._high_mm = d.low_mm, d.high_mm
        self._frequency_ratio = mean_hz(d) / USUAL_HZ
        self._clear_rad = CLEAR_RAD * self._frequency_ratio
        # Of a standard error noise stays in a lower band, and what the field misses goes with the frequency. By the
        # root two fingertips are clear at 48 kHz as they land, and 7 of 60 drops of 110 mm^2; in proportion 15 (twin).
        self._clear_sigmas = CLEAR_SIGMAS * math.sqrt(self._frequency_ratio)
        self._most_size = MOST_SIZE if d.face_mm else math.inf
        self.departure = False
        """Whether the last fit shows the negative of fingers alone."""
        self.sure = True
        """Whether no finger of the last fit has evidence against it, which further frames may make enough."""
        self.likelihood = 1.0
        """Of a frame that is judged alone, how likely the least likely of its fingers is one, and no water."""
        self.reset()

    def reset(self) -> None:
        """Forget water, fingers and the palm."""
        self.palm.reset()
        self._known: list[Evidence] = []
        self._fingers: list[Position] = []

    def dry(self) -> None:
        """Forget water: the plate is untouched."""
        self._known = []

    def fingers(
        self, bins: Bins, fit: Fit, excess: float, t_ns: int, *, alone: bool = False, lacking: bool = False,
        beside_mm: Position | None = None,
    ) -> list[Finger]:  # fmt: skip
        """Return the fingers among the contacts of a frame's fit, with their standard errors.

        The fit leaves the share `excess` of the signal. `alone` says that no further frame will be judged, `lacking`
        that the fit lacks a finger: that turns the others' phases, and they stay what they are. At `beside_mm` a finger
        was followed beside a palm.
        """
        if self._known:
            self._known = [one for one in self._known if one.until_ns >= t_ns]
        several, noise_energy = len(fit.positions_mm) > 1, self._noise.noise_energy
        sizes = list(map(abs, fit.amplitudes))
        leads = list(map(cmath.phase, map(mul, fit.amplitudes, fit.turns) if fit.turns else fit.amplitudes))
        self.departure = min(map(abs, leads)) > DEPARTURE_RAD
        variance = self._errors.variance(fit, sizes)
        errors_mm = self._errors.sigmas_mm(fit, variance)
        self.sure, self.likelihood = True, 1.0
        of_palm = self.palm.contacts(fit, excess, bins.energy - noise_energy, t_ns, beside_mm)
        doubtful = of_palm
        if several:
            doubtful = of_palm | self._cornered(fit.positions_mm) | self._edged(fit) | self._feet.among(fit, sizes)
        fingers: list[Finger] = []
        for k, lead in enumerate(leads):
            position, energy, size = fit.positions_mm[k], fit.energies[k], sizes[k]
            if not LAG_RAD < lead < DEPARTURE_RAD or energy <= self._noise.min_signal_energy:
                continue
            sigma_rad = math.sqrt(variance / energy) if energy > 0 else math.inf
            known = self._known_at(position, errors_mm[k]) if self._known else None
            is_clear = size >= CLEAR_SIZE and lead + self._clear_sigmas * sigma_rad < self._clear_rad  # the usual case
            if known is not None and (known.is_placed if lacking else known.is_settled(size, t_ns)):
                known.see(position, t_ns)
            elif known is not None or not is_clear:
                lag_rad, share = self._phase.lag_rad(bins, fit, k)
                noise, told = self._noise.variance, energy * share
                by_noise, by_error = (
                    math.sqrt(one / told) if told > 0 else math.inf for one in (noise, max(variance - noise, 0.0))
                )
                if several and known is not None and known.state is State.WATER and energy > 0:
                    # What the fit leaves may be of a drop that it lacks, which turns the phases of the others.
                    by_error = max(by_error, LACKING * math.sqrt(max(fit.residual_energy - noise_energy, 0.0) / energy))
                look = Look(lag_rad, by_noise, by_error, min(size, self._most_size), self._frequency_ratio)
                if alone:
                    if (odds := look.log_odds()) <= SURE_ALONE:
                        continue
                    self.likelihood = min(self.likelihood, 1 / (1 + math.exp(-odds)))
                if not (alone or self._is_finger(position, look, known, t_ns, several=several)):
                    continue
                self.sure = self.sure and (known is None or known.least >= 0)
            if k not in doubtful:
                fingers.append((k, errors_mm[k], size))
            elif k in of_palm:
                self.palm.see(t_ns)
        self._fingers = [fit.positions_mm[k] for k, _, _ in fingers]
        return fingers

    def _is_finger(
        self, position_mm: Position, look: Look, known: Evidence | None, t_ns: int, *, several: bool
    ) -> bool:
        """Return whether a contact is a finger, by all its frames."""
        if known is None:
            beside = self._was_finger(position_mm, several=True)
            known = Evidence(position_mm, State.FINGER if beside else State.UNDECIDED)
            if len(self._known) < MOST:
                self._known.append(known)
        elif known.state is State.WATER and look.log_odds() > SURE and self._was_finger(position_mm, several=several):
            return True  # it covers the drop
        known.update(position_mm, look, t_ns)
        return known.is_placed

    def _known_at(self, position_mm: Position, sigma_mm: float) -> Evidence | None:
        """Return what is known of the contact nearest to a position with its standard error; None if there is none."""
        reach_mm = min(NEAR_MM + REACH_SIGMAS * sigma_mm, MOST_REACH_MM)
        near = [one for one in self._known if math.dist(one.position_mm, position_mm) < reach_mm]
        return min(near, key=lambda one: math.dist(one.position_mm, position_mm), default=None)

    def _was_finger(self, position_mm: Position, *, several: bool) -> bool:
        """Return whether a finger of the last frame may have come to a position; of several fingers none comes far."""
        reach_mm = NEAR_MM if several or len(self._fingers) > 1 else LONGEST_STEP_MM
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
