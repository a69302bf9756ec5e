"""From a residual to fingers: where the network's rough answer ends and the field atlas' precise one begins.

A finger that has just come down is placed by the network first, one that is being followed where it was
going; Gauss-Newton on the atlas does the rest. What the atlas cannot explain is searched for more fingers,
and if it still cannot, is no finger.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from msgspec.structs import replace

from touchd.localization.atlas import Array, Atlas
from touchd.localization.classify import Assessor
from touchd.localization.drift import Drift
from touchd.localization.gauss_newton import NO_FIT, STILL_MM, Fit, Refiner
from touchd.localization.model import Estimate
from touchd.localization.multitouch import Recount
from touchd.localization.noise import EXCESS_OF_HALF, SPREAD, Hearing
from touchd.localization.prediction import Course
from touchd.localization.pursuit import ENOUGH, FAIR, GOOD, NOISE_MARGIN, Search
from touchd.localization.stillness import Rest
from touchd.touch import Touch

FAINT = 6.0
"""A finger with less than so many times the noise's energy may be seen elsewhere by the network."""
AMBIGUOUS_MM = 7.0
"""A faint finger that may as well be so far away is not placed."""
FIRST_STEPS, FOLLOW_STEPS = 5, 3
_STILL_TOGETHER_MM = STILL_MM / 4
"""After a shorter step the next one would be less than 1e-3 mm; of fingers that are followed few are longer."""
_DRIFT_EVERY_S = 0.04


class Locator:
    """Places the fingers of one frame after the other."""

    def __init__(self, atlas: Atlas) -> None:
        self._refiner = Refiner(atlas)
        self._drift = Drift(atlas)
        self._hearing = Hearing(atlas)
        self._search = Search(atlas, Refiner(atlas))
        self._recount = Recount(self._refiner, self._search, self._hearing)
        self._assessor = Assessor(atlas, self._hearing)
        self._course = Course()
        self._rest = Rest(atlas, self._refiner)
        self._untouched: Array = np.zeros(atlas.size, np.float32)
        self._baseline: Array = atlas.baseline
        self._left_out = np.zeros(atlas.description.acquisition.channels, bool)
        self.watch_still = True
        """Whether `holds` will be asked."""
        self.rebase(atlas.baseline)
        self.forget()

    @property
    def drift(self) -> Drift:
        """What is known of the plate's temperature, gains and dead channels."""
        return self._drift

    @property
    def tracks(self) -> bool:
        """Whether fingers of the last frame are being followed."""
        return bool(self._course.places_mm)

    def learn(self, residuals: Array, baseline: Array) -> None:
        """Start afresh on an untouched plate, (channels, samples), from the residuals of its frames, (n, ...)."""
        self._hearing.forget()
        self.rebase(baseline)
        for residual in residuals:
            self.hear(residual)
        self._listen_to(~self._drift.dead)
        self.forget()

    def rebase(self, baseline: Array) -> None:
        """Take note of the untouched plate as it is now, of shape (channels, samples)."""
        self._baseline = baseline
        self._drift.rebase(baseline)
        self._assessor.per_strength = math.sqrt(self._search.mean_energy / self._drift.signal_energy)
        self._listen_to(~self._drift.dead)

    def hear(self, residual: Array) -> None:
        """Take in the residual of an untouched frame, shape (channels, samples)."""
        self._assessor.dry()
        self._drift.features(residual, self._untouched)
        if self._hearing.hear(self._untouched):
            self._listen_to(~self._drift.dead)

    def hear_anew(self) -> None:
        """Take note that the noise is another from now on; what it was holds until enough of it is heard."""
        self._hearing.hear_anew()

    def leave_out(self, channels: np.typing.NDArray[np.bool_]) -> None:
        """Listen to no channels of these, shape (channels,), until others are named; their residual is zero."""
        self._left_out = channels
        self._rest.armed = False
        self._listen_to(~self._drift.dead)

    def forget(self) -> None:
        """Start afresh with the next frame: no finger is being followed."""
        self._lose()
        self._rest.armed = False
        self._assessor.forget()
        self._recount.forget()
        self._drift_s = 0.0
        self.leaving = False
        """Whether the last frame shows the negative of fingers: they were part of the baseline, and have gone."""
        self._drift.settle()

    def locate(
        self, residual: Array, elapsed_s: float, confident: float, start: Callable[[], Estimate]
    ) -> tuple[Touch, ...]:
        """Return the fingers of a frame; their force is the change of the signal, as a share of its size.

        Parameters
        ----------
        residual : array of shape (channels, samples)
            The frame less the baseline, ADC counts.
        elapsed_s : float
            Time since the last frame; 0 for a frame by itself.
        confident : float
            A fit of less confidence is no finger.
        start : callable
            Asks the network where a finger that has just come down is.
        """
        refiner, hearing, expected = self._refiner, self._hearing, self._hearing.expected
        followed = self.tracks
        self._drift.features(residual, refiner.frame)
        energy = refiner.take()
        signal = energy - expected
        self.leaving = False
        # A trigger that comes early or late delays all channels alike, which looks like a faint finger on the emitter.
        told = signal if followed else signal - hearing.by_itself(refiner.frame)
        if told <= SPREAD * expected:
            self._recount.abandon()
            return self._lose()
        if followed:
            fit = self._follow(elapsed_s, signal)
        elif self._recount.pending:
            fit = replace(NO_FIT, left=energy)  # where to begin is being searched already
        else:
            fit = self._begin(start, signal)
        excess = hearing.excess(fit.left, signal)
        if self._recount.is_due(excess, signal, elapsed_s):
            # Only one finger that is well explained can wait for what may be beside it; of several, or after a change,
            # one may be lost for as long as the search takes.
            waits = not followed or (len(fit.places_mm) == 1 and excess < FAIR)
            fit = self._look_again(fit, residual, signal, elapsed_s if waits else 0.0, followed=followed)
            excess = hearing.excess(fit.left, signal)
        significant = sum(fit.energies) > hearing.least
        confidence = 1 / (1 + (max(excess, 0.0) / EXCESS_OF_HALF) ** 2) if significant else 0.0
        # An emitter that falls silent, or a gain that changes, looks like a finger on the emitter: but what the plate
        # and its electronics do by themselves explains it better. A finger that is followed was none of that.
        by_itself = excess > (GOOD if followed else ENOUGH) and energy - hearing.by_itself(refiner.frame) < fit.left
        if by_itself or not confidence >= confident or (self._recount.pending and not followed):
            return self._lose()
        if hearing.is_alike and not followed and signal < FAINT * expected and len(fit.places_mm) == 1:
            fit = replace(fit, information=fit.information.copy())  # other fits write over it
            if self._is_ambiguous(fit):
                return self._lose()
        self._drift_s += elapsed_s
        if excess < GOOD and self._drift_s > _DRIFT_EVERY_S:
            self._drift.follow(refiner.residual(fit), self._drift_s)
            self._drift_s = 0.0
        self._course.take(fit.places_mm, elapsed_s)
        self._rest.arm(fit, self._course.moved_mm if self.watch_still else math.inf, hearing.variance)
        touches = self._assessor.touches(fit, confidence, elapsed_s)
        self.leaving = self._assessor.leaving
        return touches

    def holds(self, residual: Array) -> bool:
        """Return whether the finger of the last frame located is still where it was, but for the noise."""
        if not self._rest.armed:
            return False
        self._drift.features(residual, self._rest.frame)
        return self._rest.holds(2 * (1 + NOISE_MARGIN) * self._hearing.expected)

    def _begin(self, start: Callable[[], Estimate], signal: float) -> Fit:
        """Fit one finger from where the network sees it; a faint one, of which it may be wrong, from others too."""
        estimate = start()
        fits = []
        if math.isfinite(estimate.x_mm) and math.isfinite(estimate.y_mm):
            fits.append(self._refiner.one(estimate.x_mm, estimate.y_mm, FIRST_STEPS))
            if signal >= FAINT * self._hearing.expected:
                return fits[0]
        found = self._search.candidates(self._refiner.frame)
        fits += [self._refiner.one(*candidate.place_mm, FIRST_STEPS) for candidate in found]
        best = min(fits, key=lambda fit: fit.left, default=replace(NO_FIT, left=self._refiner.energy))
        return self._refiner.one(*best.places_mm[0], 1) if best.places_mm else best

    def _is_ambiguous(self, fit: Fit) -> bool:
        """Return whether a finger elsewhere leaves as little as noise: what is alike in many bins resembles one."""
        noise = (1 + SPREAD) * self._hearing.expected
        for candidate in self._search.candidates(self._refiner.frame):
            other = self._refiner.one(*candidate.place_mm, FIRST_STEPS)
            if other.left < noise and math.dist(other.places_mm[0], fit.places_mm[0]) > AMBIGUOUS_MM:
                return True
        return False

    def _follow(self, elapsed_s: float, signal: float) -> Fit:
        """Fit the fingers of the last frame from where they were going, less those that have lifted."""
        places = self._course.ahead(elapsed_s)
        if len(places) == 1:
            fit = self._refiner.one(*places[0], FOLLOW_STEPS)
            if self._hearing.excess(fit.left, signal) < FAIR:
                return fit
            # It may have turned sharply, or stopped: then it is nearer to where it was.
            other = self._refiner.one(*self._course.places_mm[0], FIRST_STEPS)
            return other if other.left < fit.left else self._refiner.one(*fit.places_mm[0], 1)
        fit, dropped = self._recount.prune(self._refiner.several(places, FOLLOW_STEPS - 1, _STILL_TOGETHER_MM), signal)
        for count, k in enumerate(dropped):
            self._course.drop(k, len(places) - count)
        return fit

    def _look_again(self, fit: Fit, residual: Array, signal: float, elapsed_s: float, *, followed: bool) -> Fit:
        """Search for what the fit does not explain: a channel that has died, further fingers, other places."""
        if not self._recount.pending:
            silent = self._drift.silent(residual, self._baseline)
            if silent.any() and not silent.all() and (silent & self._hearing.channels).any():
                self._listen_to(self._hearing.channels & ~silent)
                return self._refiner.one(*fit.places_mm[0], FIRST_STEPS) if fit.places_mm else fit
        fit, known = self._recount.look(fit, signal, elapsed_s, followed=followed)
        if not known:
            self._course.turn()
        return fit

    def _lose(self) -> tuple[Touch, ...]:
        """Take note that there is no finger."""
        self._course.forget()
        return ()

    def _listen_to(self, channels: np.typing.NDArray[np.bool_]) -> None:
        """Leave out the other channels, and bins that drown in noise."""
        self._hearing.listen_to(channels & ~self._left_out, self._drift.directions)
        self._refiner.mask = self._hearing.mask
