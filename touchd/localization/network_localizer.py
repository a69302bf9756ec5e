"""Where the fingers are in a frame that is not untouched: features -> model, and the field atlas where there is one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import Settings
from touchd.detection.baseline import Baseline
from touchd.detection.gate import Gate
from touchd.frame import Acquisition
from touchd.keypad import Layout
from touchd.localization.atlas_localizer import Locator
from touchd.localization.features import make_features, noise_to_signal
from touchd.localization.model import Estimate, Model
from touchd.localization.still import Still
from touchd.outcome import Counters
from touchd.touch import Touch

REBASE_S = 1.0
"""How often the untouched plate's temperature and gains are looked at: far more slowly they change."""
DRIFTED = 0.1
"""The baseline has moved if by this share of a frame's noise energy: on glass 0.05 K at 60 dB."""
HEAR_EVERY = 16
"""Of so many untouched frames one tells what noise there is in the bins."""


class Finder:
    """Places a finger by the network alone.

    Parameters
    ----------
    acquisition, model, settings, layout
        Those of the pipeline.
    baseline : Baseline
        Holds each frame's residual.
    gate : Gate
        Knows the noise.
    counters : Counters
        Told what ran and what did not.
    """

    def __init__(
        self,
        acquisition: Acquisition,
        model: Model,
        settings: Settings,
        layout: Layout | None,
        baseline: Baseline,
        gate: Gate,
        counters: Counters,
    ) -> None:
        self._model, self._baseline, self._gate, self._counters = model, baseline, gate, counters
        self._features = make_features(model.description.domain, acquisition)
        self._input = model.features.reshape(self._features.shape)
        self._flat, self._power = model.features.reshape(-1), np.zeros((), np.float32)
        self._of_residual = model.description.input == "residual"
        self._residual = baseline.residual
        self._signal = baseline.residual if self._of_residual else baseline.signal
        self._still = Still(acquisition.shape, settings.skip.still_false_alarm_rate)
        self._located: tuple[Touch, ...] = ()  # the fingers of the frame looked at last
        self._signal_energy = 1.0
        self._energy = self._elapsed_s = 0.0
        self._untouched_frames, self._followed_s = 0, 0.0
        self._prepare()
        self.retune(settings, layout)

    def _prepare(self) -> None:
        """Make what a kind of finder has of its own."""

    def retune(self, settings: Settings, layout: Layout | None) -> None:
        """Take other thresholds and keys."""
        self._min_confidence, self._keep_confidence = settings.model.min_confidence, settings.model.keep_confidence
        self._min_snr = 10 ** (settings.model.min_snr_db / 10)
        # The other heads' sigma is the size of a zone or a key, whatever the frame.
        regression = self._model.description.head == "regression"
        self._max_sigma_mm = settings.model.max_sigma_mm if regression else math.inf
        self._force_full_scale = settings.tracker.force_full_scale
        self._layout = layout
        self._skip_still = settings.skip.still
        self._still.retune(settings.skip.still_false_alarm_rate)
        self.forget()

    def learned(self) -> None:
        """Take note that the baseline was learned anew."""
        self._signal_energy = max(self._baseline.energy(), 1.0)  # a dead DAQ sends zeros
        self.forget()

    def hear_anew(self) -> None:
        """Take note that the noise is another from now on."""

    def leave_out(self, channels: NDArray[np.bool_]) -> None:
        """Take note that some channels, shape (channels,), say nothing: the network sees no change in them."""

    def untouched(self, elapsed_s: float, *, followed: bool) -> None:
        """Take note of an untouched frame, and whether the baseline followed it."""
        if self._located:
            self.forget()
        self._untouched_frames += 1
        if self._untouched_frames % HEAR_EVERY == 0:
            self._hear()
        self._followed_s += elapsed_s
        if followed and self._followed_s > REBASE_S:
            self._followed_s = 0.0
            self._rebase()

    def forget(self) -> None:
        """Forget the fingers: there is none any more."""
        self._located = ()
        self._still.forget()

    def is_faint(self, energy: float, /) -> bool:
        """Return whether a residual of this energy tells that something is there, but not where."""
        return energy < self._min_snr * self._gate.noise_energy

    def find(self, energy: float, elapsed_s: float, *, alive: bool) -> tuple[Touch, ...]:
        """Return the fingers of this frame: found anew, or those of the frame looked at last if nothing has changed.

        Parameters
        ----------
        energy : float
            Of the residual, counts squared.
        elapsed_s : float
            Time since the last frame.
        alive : bool
            Whether a contact is down, of whom less confidence is asked.
        """
        # What lets features and network be skipped: but for the noise they would see what they have seen. Where no
        # finger was found they look again: something is there, and under other noise it may be one.
        if self._located and self._holds():
            self._counters.skipped["still"] += 1
            return self._located
        self._energy, self._elapsed_s = energy, elapsed_s
        self._located = self._look(self._keep_confidence if alive else self._min_confidence)
        return self._located

    def leaving(self) -> bool:
        """Return whether the negative of the residual is a finger: one that the baseline held has gone."""
        if not self._of_residual:
            return False
        features = self._model.features
        np.negative(features, features)
        leaving = self._model.estimate().confidence >= self._min_confidence
        np.negative(features, features)
        return leaving

    def spectrum(self) -> list[float]:
        """Return the features of this frame."""
        self._features.extract(self._signal, self._input)
        features: list[float] = self._model.features[0].tolist()
        return features

    def _hear(self) -> None:
        """The network was told in training what noise there is, and of every temperature."""

    def _rebase(self) -> None:
        """As `_hear`."""

    def _holds(self) -> bool:
        return self._still.holds(self._residual)

    def _look(self, confident: float) -> tuple[Touch, ...]:
        if self._skip_still:
            self._still.look(self._residual, self._gate)
        estimate = self._estimate()
        self._flat.dot(self._flat, self._power)
        sigma_mm = estimate.error_mm(noise_to_signal(self._features, self._gate.noise_energy, self._power.item()))
        # Asked this way round, so that a network that says NaN places nothing.
        if not (estimate.confidence >= confident and sigma_mm <= self._max_sigma_mm):
            return ()
        force = (self._energy / self._signal_energy) ** 0.5
        return self._finish((Touch(estimate.x_mm, estimate.y_mm, sigma_mm, estimate.confidence, force, estimate.key),))

    def _estimate(self) -> Estimate:
        """Features and network."""
        self._features.extract(self._signal, self._input)
        self._counters.inferred += 1
        return self._model.estimate()

    def _finish(self, touches: tuple[Touch, ...]) -> tuple[Touch, ...]:
        """Return touches, whose force is the change of the signal, with their force in full scales, and their keys."""
        for touch in touches:
            touch.force = min(1.0, touch.force / self._force_full_scale)
            if self._layout:
                touch.key = self._layout.at(touch.x_mm, touch.y_mm)
        return touches


class AtlasFinder(Finder):
    """Places fingers on the field atlas; the network only says where to begin."""

    def _prepare(self) -> None:
        assert self._model.atlas is not None
        self._locator = Locator(self._model.atlas)
        self._rebased = np.zeros_like(self._baseline.mean)
        self._moved = np.zeros_like(self._baseline.mean)

    def learned(self) -> None:
        """Take note that the baseline was learned anew."""
        super().learned()
        np.copyto(self._rebased, self._baseline.mean)
        self._locator.learn(self._baseline.window - self._baseline.mean, self._baseline.mean)

    def forget(self) -> None:
        """Forget the fingers: there is none any more."""
        self._located = ()
        self._locator.forget()

    def is_faint(self, _energy: float, /) -> bool:
        """Return False: noise may drown the samples and leave most bins clear, which the locator sees."""
        return False

    def hear_anew(self) -> None:
        """Take note that the noise is another from now on."""
        self._locator.hear_anew()

    def leave_out(self, channels: NDArray[np.bool_]) -> None:
        """Take note that some channels, shape (channels,), say nothing."""
        self._locator.leave_out(channels)

    def leaving(self) -> bool:
        """Return whether the negative of the residual is a finger: one that the baseline held has gone."""
        return self._locator.leaving

    def _hear(self) -> None:
        self._locator.hear(self._residual)

    def _rebase(self) -> None:
        mean, moved = self._baseline.mean, self._moved
        np.subtract(mean, self._rebased, out=moved)
        flat = moved.reshape(-1)
        # What the baseline has moved by is far below what is seen of one frame, and so is what it does to a place.
        if float(flat.dot(flat)) > DRIFTED * self._gate.noise_energy:
            np.copyto(self._rebased, mean)
            self._locator.rebase(mean)

    def retune(self, settings: Settings, layout: Layout | None) -> None:
        """Take other thresholds and keys."""
        super().retune(settings, layout)
        self._locator.watch_still = settings.skip.still

    def _holds(self) -> bool:
        return self._locator.holds(self._residual)

    def _look(self, confident: float) -> tuple[Touch, ...]:
        inferred, tracked = self._counters.inferred, self._locator.tracks
        found = self._locator.locate(self._residual, self._elapsed_s, confident, self._estimate)
        if self._counters.inferred == inferred:
            # What lets the network be skipped: the finger was followed, and is where it was going; or there is so
            # little above the noise that something may be there, but where cannot be told.
            self._counters.skipped["tracking" if tracked else "faint"] += 1
        return self._finish(tuple([touch for touch in found if touch.sigma_mm <= self._max_sigma_mm]))


def finder_for(model: Model) -> type[Finder]:
    """Return what places fingers with a model: on its field atlas, if it was loaded with one."""
    return AtlasFinder if model.atlas is not None else Finder
