"""From a residual to fingers: where the network's rough answer ends and the field atlas' precise one begins.

A finger that has just come down is placed by the network first, one that is being followed where it was
going; Gauss-Newton on the atlas does the rest. What the atlas cannot explain is searched for more fingers,
and if it still cannot, is no finger.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from touchd.atlas import Array, Atlas
from touchd.drift import Drift
from touchd.model import Estimate
from touchd.noise import Noise
from touchd.lookup import Place
from touchd.refine import Fit, Refiner, sigmas_mm
from touchd.rest import Rest
from touchd.search import ENOUGH, GOOD, NOISE_MARGIN, WORTH, Search, is_worth
from touchd.tracker import Touch

EXCESS_OF_HALF = 0.25
"""Share of the signal that a fit leaves unexplained at which it is as likely no finger: fingers unlike those of the
training leave up to 0.1, palms more than 0.6 (twin)."""
PHASE_RAD = (-1.2, 0.45)
"""Of a finger's strength. What leads by more has no loss: a mass, as a drop of water is. Drops lead by 0.6, fingers by
less than 0.3; human fingers lag by up to 0.4 (twin)."""
PHASE_SIGMAS = 2.5
"""So far within the upper bound a finger's phase has to be: that of a faint drop scatters, and it stays for hours."""
WET_RAD, WET_MM = 0.15, 3.0
"""What leads by so much is a drop still, where there was one so near in the last frame."""
LEAVING_RAD = 2.0
"""A strength so far from a finger's is one with the opposite sign: a finger that the baseline held has gone."""
UNUSUAL = 8.0
"""What a finger unlike those of the training leaves counts so much more than noise: it is alike in many bins."""
FAINT = 6.0
"""A finger with less than so many times the noise's energy may be seen elsewhere by the network."""
SIGNIFICANT = 80.0
"""What a fit explains, in variances of a feature, for noise alone not to do so anywhere on a plate: at the best of a
thousand places noise explains some 15, neighbouring bins being correlated twice that."""
FIRST_STEPS, FOLLOW_STEPS = 5, 3
_DRIFT_EVERY_S = 0.04
_SEARCH_SOON_S, _SEARCH_AGAIN_S = 0.02, 0.05
_SEARCH_SELDOM_S = 2.0
_GAIN = 0.8
_NOISE_SPREAD = 0.25
"""Noise has seldom so much more energy in a frame than its mean: two deviations."""
_WEAK = 1.4
"""A finger of less energy than so many times what the fit leaves is none: the other side of the search's worth."""
_LONGEST_STEP_MM = 8.0
_NONE = Fit([], [], [], np.zeros((0, 0)), 0.0)


class Locator:
    """Places the fingers of one frame after the other."""

    def __init__(self, atlas: Atlas) -> None:
        d = atlas.description
        self._refiner = Refiner(atlas)
        self._search = Search(atlas, self._refiner)
        self._drift = Drift(atlas)
        self._rest = Rest(atlas, self._refiner)
        self._noise = Noise(d.acquisition.channels, len(d.bins))
        self._untouched: Array = np.zeros(atlas.size, np.float32)
        self._energy = np.zeros((), np.float32)
        self._moved_mm = math.inf
        self._noise_scale, self._field_scale = d.noise_scale, d.field_scale
        self._error = atlas.error
        self._per_channel = 2 * len(d.bins)
        self._baseline: Array = atlas.baseline
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
        return bool(self._fit.places_mm)

    def learn(self, residuals: Array, baseline: Array) -> None:
        """Start afresh on an untouched plate, (channels, samples), from the residuals of its frames, (n, ...)."""
        self._noise.forget()
        self.rebase(baseline)
        for residual in residuals:
            self.hear(residual)
        self._listen_to(~self._drift.dead)
        self.forget()

    def rebase(self, baseline: Array) -> None:
        """Take note of the untouched plate as it is now, of shape (channels, samples)."""
        self._baseline = baseline
        self._drift.rebase(baseline)
        self._per_strength = math.sqrt(self._search.mean_energy / self._drift.signal_energy)
        self._listen_to(~self._drift.dead)

    def hear(self, residual: Array) -> None:
        """Take in the residual of an untouched frame, shape (channels, samples)."""
        self._drift.features(residual, self._untouched)
        self._noise.hear(self._untouched)

    def forget(self) -> None:
        """Start afresh with the next frame: no finger is being followed."""
        self._fit = _NONE
        self._rest.armed = False
        self._wet: list[Place] = []
        self._speed: list[Place] = []
        self._search_s, self._wait_s, self._drift_s, self._unexplained = math.inf, 0.0, 0.0, math.inf
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
            Time since the last frame.
        confident : float
            A fit of less confidence is no finger.
        start : callable
            Asks the network where a finger that has just come down is.
        """
        refiner = self._refiner
        self._search_s += elapsed_s
        self._drift.features(residual, refiner.frame)
        energy = refiner.take()
        expected = self._expected
        signal = energy - expected
        self.leaving = False
        told = energy
        if not self._fit.places_mm:
            # A trigger that comes early or late delays all channels alike, which looks like a faint finger on the
            # emitter.
            np.dot(self._own, refiner.frame, out=self._by_itself)
            self._by_itself.dot(self._by_itself, self._energy)
            told -= self._energy.item()
        if told - expected <= _NOISE_SPREAD * expected:
            self._fit, self._speed = _NONE, []
            return ()
        fit = self._follow(elapsed_s, expected, signal) if self._fit.places_mm else self._begin(start, signal)
        excess = self._excess(fit, expected, signal)
        if excess > GOOD / 2 and self._may_search(excess * signal):
            fit = self._look_again(fit, residual, expected, signal)
            excess = self._excess(fit, expected, signal)
        significant = sum(fit.energies) > SIGNIFICANT * expected / self._alive
        confidence = 1 / (1 + (max(excess, 0.0) / EXCESS_OF_HALF) ** 2) if significant else 0.0
        if not confidence >= confident:
            self._fit, self._speed = _NONE, []
            return ()
        self._drift_s += elapsed_s
        if excess < GOOD and self._drift_s > _DRIFT_EVERY_S:
            self._drift.follow(refiner.residual(fit), self._drift_s)
            self._drift_s = 0.0
        self._learn_speed(fit, elapsed_s)
        self._fit = fit
        moved_mm = self._moved_mm if self.watch_still else math.inf
        self._rest.arm(fit, moved_mm, self._noise_scale * self._expected / self._alive)
        self.leaving = all(abs(cmath.phase(z)) > LEAVING_RAD for z in fit.strengths)
        return self._touches(fit, confidence)

    def holds(self, residual: Array) -> bool:
        """Return whether the finger of the last frame located is still where it was, but for the noise."""
        if not self._rest.armed:
            return False
        self._drift.features(residual, self._rest.frame)
        return self._rest.holds(2 * (1 + NOISE_MARGIN) * self._expected)

    def _begin(self, start: Callable[[], Estimate], signal: float) -> Fit:
        """Fit one finger from where the network sees it; a faint one, of which it may be wrong, from others too."""
        estimate = start()
        fits = []
        if math.isfinite(estimate.x_mm) and math.isfinite(estimate.y_mm):
            fits.append(self._refiner.one(estimate.x_mm, estimate.y_mm, FIRST_STEPS))
        if not fits or signal < FAINT * self._expected:
            places = self._search.candidates(self._refiner.frame)
            fits += [self._refiner.one(*place, FIRST_STEPS) for place in places]
        best = min(fits, key=lambda fit: fit.left)
        return self._refiner.one(*best.places_mm[0], 1) if len(fits) > 1 else best

    def _follow(self, elapsed_s: float, expected: float, signal: float) -> Fit:
        """Fit the fingers of the last frame from where they were going, less those that have lifted."""
        places = [
            (x + vx * elapsed_s, y + vy * elapsed_s)
            for (x, y), (vx, vy) in zip(self._fit.places_mm, self._speed, strict=True)
        ]
        if len(places) == 1:
            return self._refiner.one(*places[0], FOLLOW_STEPS)
        return self._prune(self._refiner.several(places, FOLLOW_STEPS - 1), expected, signal)

    def _prune(self, fit: Fit, expected: float, signal: float) -> Fit:
        """Return a fit without the fingers that explain next to nothing: they have lifted, or were none."""
        while len(fit.places_mm) > 1:
            weakest = int(np.argmin(fit.energies))
            if fit.energies[weakest] > _WEAK * max(fit.left - expected, ENOUGH * signal):
                break
            if len(self._speed) == len(fit.places_mm):
                del self._speed[weakest]
            fit = self._refiner.several([p for k, p in enumerate(fit.places_mm) if k != weakest], FOLLOW_STEPS - 1)
        return fit

    def _look_again(self, fit: Fit, residual: Array, expected: float, signal: float) -> Fit:
        """Search for what the fit does not explain: a channel that has died, further fingers, other places."""
        known = fit.places_mm
        silent = self._drift.silent(residual, self._baseline)
        if silent.any() and not silent.all() and (silent & self._listening).any():
            self._listen_to(self._listening & ~silent)
            return self._refiner.one(*known[0], FIRST_STEPS) if known else fit
        tracked = bool(self._fit.places_mm)
        found = self._search.add(fit, expected) if tracked else fit
        if self._excess(found, expected, signal) > GOOD / 2:
            anew = self._search.add(_NONE._replace(left=self._refiner.energy), expected)
            if is_worth(anew, found, expected):
                found, self._speed = anew, []  # in another order: the speeds are others'
        found = self._without_movement(self._prune(found, expected, signal), expected)
        # What nothing explains is not searched again with each frame, unless it has become much more.
        excess = self._excess(found, expected, signal)
        worth = excess < EXCESS_OF_HALF / 2 and found.left < _GAIN * fit.left
        self._wait_s = 0.0 if worth else min(max(2 * self._wait_s, _SEARCH_AGAIN_S), _SEARCH_SELDOM_S)
        self._search_s = 0.0
        self._unexplained = max(excess, 0.0) * signal
        return found

    def _without_movement(self, fit: Fit, expected: float) -> Fit:
        """Return a fit without the further fingers that the plate's own movement explains nearly as well."""
        for k in range(len(fit.places_mm) - 1, -1, -1):
            if len(fit.places_mm) < 2:
                break
            others = [j for j in range(len(fit.places_mm)) if j != k]
            rest = fit._replace(
                places_mm=[fit.places_mm[j] for j in others], strengths=[fit.strengths[j] for j in others]
            )
            left = self._refiner.residual(rest)
            along = self._own @ left
            if (
                float(left @ left) - float(along @ along) - expected
                < max(fit.left - expected, 0.0) / WORTH + expected / 4
            ):
                fit = self._refiner.several(rest.places_mm, FOLLOW_STEPS - 1)
                self._speed = []
        return fit

    def _may_search(self, unexplained: float) -> bool:
        """Return whether it is time to search, with so much energy left: a search takes as long as many frames."""
        much_more = unexplained > 2 * self._unexplained
        return self._search_s >= (min(self._wait_s, _SEARCH_SOON_S) if much_more else self._wait_s)

    def _excess(self, fit: Fit, expected: float, signal: float) -> float:
        """Return what a fit leaves beyond what noise may have, as a share of the signal."""
        return (fit.left - (1 + _NOISE_SPREAD) * expected) / signal

    def _learn_speed(self, fit: Fit, elapsed_s: float) -> None:
        """Follow each finger's velocity, mm/s, over some three frames."""
        before = self._fit.places_mm
        self._moved_mm = math.dist(before[0], fit.places_mm[0]) if len(before) == len(fit.places_mm) == 1 else math.inf
        if len(before) != len(fit.places_mm) or len(self._speed) != len(before) or elapsed_s <= 0:
            self._speed = [(0.0, 0.0)] * len(fit.places_mm)
            return
        longest = _LONGEST_STEP_MM / elapsed_s

        def blend(old: float, now_mm: float, then_mm: float) -> float:
            return max(-longest, min(longest, old + 0.5 * ((now_mm - then_mm) / elapsed_s - old)))

        self._speed = [
            (blend(vx, now[0], then[0]), blend(vy, now[1], then[1]))
            for (vx, vy), now, then in zip(self._speed, fit.places_mm, before, strict=True)
        ]

    def _touches(self, fit: Fit, confidence: float) -> tuple[Touch, ...]:
        """Return the fingers of a fit with their standard errors; what is water is none."""
        usual = self._mean_error * sum(abs(z) ** 2 for z in fit.strengths) / 2
        left = max(fit.left - (1 + _NOISE_SPREAD) * self._expected, 0.0) / self._alive
        error = self._field_scale * usual + UNUSUAL * max(left - usual, 0.0)
        errors_mm = sigmas_mm(fit.information, self._noise_scale * self._expected / self._alive + error)
        scatter = self._noise_scale * self._expected / self._alive  # over a finger's energy it is that of its phase
        touches, wet = [], []
        for place, z, energy, sigma_mm in zip(fit.places_mm, fit.strengths, fit.energies, errors_mm, strict=True):
            phase = cmath.phase(z)
            limit = PHASE_RAD[1] - PHASE_SIGMAS * math.sqrt(scatter / energy) if energy > 0 else -math.inf
            # A drop stays where it is: where one was seen, what is half-way to it still is one.
            if phase >= limit or (phase > WET_RAD and any(math.dist(place, drop) < WET_MM for drop in self._wet)):
                wet.append(place)
            elif phase > PHASE_RAD[0]:
                touches.append(Touch(*place, sigma_mm, confidence, abs(z) * self._per_strength))
        self._wet = wet
        return tuple(touches)

    def _listen_to(self, channels: NDArray[np.bool_]) -> None:
        """Leave out dead channels, and bins that drown in noise."""
        if not channels.any():
            channels = np.ones_like(channels)  # nothing can be said; what the frames hold decides
        self._listening = channels
        features = np.repeat(channels, self._per_channel) & self._noise.quiet()
        self._refiner.mask = None if features.all() else features.astype(np.float32)
        self._alive = max(int(features.sum()), 1)
        self._expected = float(self._noise.power[features].sum())
        self._mean_error = float(self._error[channels].mean())
        # Of what is listened to, orthonormal again.
        own = self._drift.directions
        self._own = own if features.all() else np.linalg.qr((own * features).T)[0].T.astype(np.float32)
        self._by_itself = np.zeros(len(self._own), np.float32)
