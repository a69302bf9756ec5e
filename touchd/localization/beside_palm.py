"""A finger beside a hand that rests, in what has changed of the frame since it was not there.

The hand's contacts are wider than the model reaches: what they leave of the frame is more than a finger changes. But in
the time in which a finger lands a hand moves little, and the difference of two frames is the finger's alone. Of taps
beside hands of six patches it finds nine in ten; the frame itself shows one in twenty (twin).
"""

from __future__ import annotations

import cmath
import math
from collections import deque
from typing import NamedTuple

import numpy as np

from touchd.config.schema import ModelSettings
from touchd.detection.detection import Detection
from touchd.localization.atlas import Array, Atlas
from touchd.localization.estimator import TouchMaker
from touchd.localization.fit import Bins, Fit
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.plate_model import PlateModel
from touchd.localization.position_error import PositionError
from touchd.localization.pursuit import Pursuit
from touchd.localization.spline import Position
from touchd.touch import PalmArea, Touch

BEFORE_NS = 44_000_000
"""Age of the frame that is compared with: a finger lands within 30 ms."""
SCAN_NS = 16_000_000
"""A finger that lands is looked for this often."""
LEAST = 4.0
"""The difference has more energy than its noise by this factor."""
LAG_RAD, LEAD_RAD = -1.2, 0.5
"""Between these phases is a finger: -0.6 to 0.4 rad (twin); one that lifts is at pi."""
LIFTED = 0.25
"""One whose amplitude falls below this share of its largest lifts."""
REACH_MM = 8.0
"""No finger goes farther in a frame."""
SAME_MM = 15.0
"""Nearer to a finger that the whole frame shows it is that one."""
STIRS = 0.3
"""A hand stirs if a contact of this amplitude is the most of what has changed."""
STILL_NS, STILL_REACH_MM = 200_000_000, 40.0
"""Where nothing has stirred for so long, what lands this far from a hand's middle is no part of it."""
_STEPS, _FOLLOW_STEPS = 5, 3


class _Before(NamedTuple):
    """A frame to compare with."""

    t_ns: int
    vector: Array
    mask: Array | None
    still: bool
    """Whether nothing had stirred for a while."""


class _Found(NamedTuple):
    """A finger beside a palm."""

    fit: Fit
    """Of what has changed."""
    excess: float
    """Share of it that this leaves."""


class BesidePalm:
    """Finds one finger beside a palm, and follows it.

    Parameters
    ----------
    atlas : Atlas
    plate : PlateModel
    pursuit : Pursuit
        Names places to begin.
    """

    def __init__(self, atlas: Atlas, plate: PlateModel, pursuit: Pursuit) -> None:
        self._plate, self._noise, self._pursuit = plate, plate.noise, pursuit
        self._solver, self._errors = GaussNewton(atlas), PositionError(atlas, plate.noise)
        self.reset()

    def reset(self) -> None:
        """Forget the frames before, and the finger."""
        self._frames: deque[_Before] = deque()
        self._before: _Before | None = None  # what a finger that is followed is compared with
        self._finger: _Found | None = None
        self._largest, self._scanned_ns, self._stirred_ns = 0.0, 0, 0

    @property
    def place_mm(self) -> Position | None:
        """Where the finger is that is followed."""
        return self._finger.fit.positions_mm[0] if self._finger else None

    def add(
        self, detection: Detection, touches: tuple[Touch, ...], palm: PalmArea | None, maker: TouchMaker,
        limits: ModelSettings,
    ) -> tuple[Touch, ...]:  # fmt: skip
        """Add the finger beside a palm to the touches of a frame, unless the whole frame shows it too.

        `limits` are the least confidences and the largest standard error, as for other fingers.
        """
        if palm is None:
            if self._frames:
                self.reset()
            return touches
        t_ns, bins = detection.t_ns, self._plate.bins(detection.residual, detection.hits)
        if self._frames and t_ns <= self._frames[-1].t_ns:
            self.reset()  # the clock went back
        if not self._frames:
            self._stirred_ns = t_ns
        still = t_ns - self._stirred_ns >= STILL_NS
        self._frames.append(_Before(t_ns, bins.vector.copy(), bins.mask, still))
        while len(self._frames) > 1 and self._frames[1].t_ns <= t_ns - BEFORE_NS:
            self._frames.popleft()
        self._finger = self._follow(bins, palm, limits) if self._finger else self._land(bins, t_ns, palm, limits)
        if self._finger is None:
            return touches
        fit, excess = self._finger
        (place_mm,), sizes = fit.positions_mm, [abs(fit.amplitudes[0])]
        if any(math.dist(place_mm, (touch.x_mm, touch.y_mm)) < SAME_MM for touch in touches):
            return touches
        variance = self._noise.variance + self._errors.variance(fit, sizes)
        (sigma_mm,) = self._errors.sigmas_mm(fit, variance)
        if not sigma_mm <= limits.max_sigma_mm:
            return touches
        finger, change = (0, sigma_mm, sizes[0]), self._plate.change(self._pursuit.mean_energy)
        return touches + maker.touches([place_mm], [finger], None, CRITERIA.confidence(excess), change)

    def _land(self, bins: Bins, t_ns: int, palm: PalmArea, limits: ModelSettings) -> _Found | None:
        before = self._frames[0]
        if t_ns - before.t_ns < BEFORE_NS or 0 <= t_ns - self._scanned_ns < SCAN_NS:
            return None
        change = _change(bins, before)
        noise = 2 * self._noise.noise_energy
        if change.energy <= LEAST * noise:
            return None
        self._scanned_ns = t_ns
        places_mm = self._pursuit.candidates(change.vector, 3)
        starts = [self._solver.fit_one(change, *place_mm, _STEPS) for place_mm in places_mm]
        if not starts:
            return None
        fit = self._solver.with_shapes(change, min(starts, key=lambda one: one.residual_energy), noise)
        if abs(fit.amplitudes[0]) > STIRS:
            self._stirred_ns = t_ns
        found = self._found(change, fit, limits.min_confidence)
        reach_mm = min(STILL_REACH_MM, palm.reach_mm) if before.still else palm.reach_mm or math.inf
        if found is None or math.dist(fit.positions_mm[0], (palm.x_mm, palm.y_mm)) < reach_mm:
            return None
        self._before, self._largest = before, abs(fit.amplitudes[0])
        return found

    def _follow(self, bins: Bins, palm: PalmArea, limits: ModelSettings) -> _Found | None:
        assert self._before is not None  # a finger is followed
        assert self._finger is not None
        change = _change(bins, self._before)
        (place_mm,) = self._finger.fit.positions_mm
        fit = self._solver.fit_one(change, *place_mm, _FOLLOW_STEPS)
        fit = self._solver.with_shapes(change, fit, 2 * self._noise.noise_energy)
        size = abs(fit.amplitudes[0])
        self._largest = max(self._largest, size)
        found = self._found(change, fit, limits.keep_confidence)
        (now_mm,) = fit.positions_mm
        own = math.dist(now_mm, (palm.x_mm, palm.y_mm)) < min(STILL_REACH_MM, palm.reach_mm)
        if found and not own and size > LIFTED * self._largest and math.dist(now_mm, place_mm) < REACH_MM:
            return found
        self.reset()
        return None

    def _found(self, change: Bins, fit: Fit, least: float) -> _Found | None:
        noise = 2 * self._noise.noise_energy
        signal = change.energy - noise
        excess = (fit.residual_energy - noise) / signal if signal > 0 else math.inf
        is_finger = CRITERIA.confidence(excess) >= least and LAG_RAD < cmath.phase(fit.amplitudes[0]) < LEAD_RAD
        return _Found(fit, excess) if is_finger else None


def _change(bins: Bins, before: _Before) -> Bins:
    """Return what has changed, in the bins that both frames use."""
    vector, mask = bins.vector - before.vector, bins.mask
    if before.mask is not None:
        mask = before.mask if mask is None else np.minimum(mask, before.mask)
    if mask is not None:
        vector *= mask
    return Bins(vector, mask, float(vector @ vector))
