"""Place fingers on the field atlas; the network only says where one that has just landed is.

A tracked finger is placed from where it was going; what is left unexplained is searched for more, or is no finger.
"""

from __future__ import annotations

import math

from touchd.config.schema import Settings
from touchd.detection.baseline import Signal
from touchd.detection.detection import Detection
from touchd.keypad import Layout
from touchd.localization.atlas import Atlas
from touchd.localization.beside_palm import BesidePalm
from touchd.localization.classify import Classifier
from touchd.localization.contact_size import ContactSize
from touchd.localization.estimator import Estimator, TouchMaker
from touchd.localization.feet import Feet
from touchd.localization.fit import Bins, Fit, Fitted, no_fit
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.following import Follower, Prediction
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.landing import FIRST_STEPS, Landing
from touchd.localization.localization import RINGS, UNTOUCHED, Localization
from touchd.localization.model import Model
from touchd.localization.model_fit import ModelFit
from touchd.localization.multitouch import MultitouchSearch
from touchd.localization.plate_model import PlateModel
from touchd.localization.pursuit import Pursuit
from touchd.localization.stillness import StillFinger
from touchd.localization.weighted_fit import Refinement, WeightedFit
from touchd.outcome import Outcome
from touchd.touch import Face, Touch


class AtlasLocalizer:
    """Places the fingers of one frame after the other.

    Parameters
    ----------
    model : Model
    atlas : Atlas
    settings : Settings
    layout : Layout, optional
        The keys, in keypad mode.
    """

    def __init__(self, model: Model, atlas: Atlas, settings: Settings, layout: Layout | None) -> None:
        self._estimator = Estimator(model)
        self._solver = GaussNewton(atlas)
        self._plate = PlateModel(atlas)
        self._noise, self._drift = self._plate.noise, self._plate.drift
        self._pursuit = Pursuit(atlas, GaussNewton(atlas))  # of its own: its frame stays while others are fitted
        self._landing = Landing(self._estimator, self._solver, self._pursuit, self._noise, atlas.description)
        weighted = WeightedFit(atlas)
        self._search = MultitouchSearch(self._solver, self._pursuit, self._noise, weighted)
        self._beside = BesidePalm(atlas, self._plate, self._pursuit)
        self._size = ContactSize(atlas, self._noise)
        self._prediction = Prediction()
        self._refinement = Refinement(weighted)
        self._follower = Follower(self._solver, self._search, self._noise, self._prediction)
        self._feet = Feet(atlas, self._solver, self._noise, self._landing, self._follower, self._pursuit)
        self._classifier = Classifier(atlas, self._noise, self._solver, self._feet)
        self._still = StillFinger(atlas, self._solver)
        self._faces: list[Face | None] = []  # of the fingers followed, as their shapes were fitted
        self._model_fit = ModelFit()
        self._touches: tuple[Touch, ...] = ()  # of the last touched frame
        self._touched = self._departure = self._plate_moved = False  # touched: fitted since the last untouched frame
        self._seen: Detection | None = None  # the last frame that `follow` has left to `localize`, ...
        self._begun: Fitted | None = None  # ... and what it has fitted there
        self.configure(settings, layout)

    def configure(self, settings: Settings, layout: Layout | None) -> None:
        """Take other thresholds and keys from the next frame on. Fingers stay, unless the feet are others."""
        self._settings, self._touch_maker = settings, TouchMaker(settings, layout)
        self._still.reset()
        if self._feet.set_places(settings.model.feet_mm):
            self.reset()

    def reset(self) -> None:
        """Forget all fingers, and water."""
        self._touches = self._lose()
        for part in (self._still, self._classifier, self._beside, self._search, self._drift):
            part.reset()

    def update(self, baseline: Signal, residuals: Signal | None = None) -> None:
        """Take another baseline, (channels, samples), and residuals that tell its noise, (n, ...); else that stays."""
        self._plate.update(baseline, residuals)
        self.reset()

    def observe(self, detection: Detection) -> Localization:
        """Follow noise and temperature on an untouched frame, and forget fingers and water."""
        if self._touched:
            self._touched = False
            self._model_fit.end_touch()
            if self._touches:
                self.reset()
            else:  # water, or what a finger left that was lost as it lifted: water stays known
                for part in (self._prediction, self._drift, self._classifier.palm):
                    part.reset()
                self._search.cancel()
        if self._plate.observe(detection):
            self._classifier.dry()
        return UNTOUCHED

    def follow(self, detection: Detection) -> Localization | None:
        """Return the fingers of the last frame if they rest, or if noise is all that they leave of a touched frame."""
        self._begin(detection)
        if self._rests(detection):
            return Localization(Outcome.STILL, self._touches)
        self._seen, self._begun = detection, None
        if self._search.pending or not self._prediction.positions_mm:
            return None
        bins = self._plate.bins(detection.residual)
        if not (signal := bins.energy - self._noise.noise_energy) > self._noise.noise_energy + self._drift.energy:
            return None
        fit = self._follower.follow(bins, detection.t_ns, signal)
        self._begun = bins, fit = self._follower.settle(self._plate, detection.hits, bins, fit, shaped=True)
        signal = bins.energy - self._noise.noise_energy
        if not self._follower.explains(fit, self._noise.excess(fit.residual_energy, signal), signal):
            return None
        return self._localization(detection, self._begun)

    def localize(self, detection: Detection, *, alive: bool, complete: bool = False) -> Localization:
        """Return the fingers of a touched frame."""
        begun = self._begun if detection is self._seen else None
        if detection is not self._seen:
            self._begin(detection)
            if self._rests(detection):
                return Localization(Outcome.STILL, self._touches)
            if detection.rings and not (alive and self._follower.has_lifted(self._plate.bins(detection.residual))):
                if not alive:  # they have ended: what comes after the knock is found afresh
                    self._touches = self._lose()
                    self._search.cancel()
                return RINGS
        return self._localization(detection, begun, alive=alive, complete=complete)

    @property
    def stretch(self) -> float | None:
        """Relative rise of the plate's resonances since training."""
        return self._drift.stretch

    def spectrum(self, detection: Detection) -> list[float]:
        """Return the network's input for a frame."""
        return self._estimator.spectrum(detection)

    @property
    def model_fit(self) -> float | None:
        """Share of a touch's energy that the model explains; None before it is known."""
        return self._model_fit.value

    def _begin(self, detection: Detection) -> None:
        """Use the frame's live channels, and no bin beside its tones; take its time."""
        if self._plate.listen(detection):
            self._still.reset()
        self._search.update(detection.t_ns, detection.period_ns, rings=detection.rings)

    def _localization(
        self, detection: Detection, begun: Fitted | None, *, alive: bool = True, complete: bool = False
    ) -> Localization:
        """Place the fingers of a frame; `begun` is what `follow` fitted in it."""
        limits, tracked = self._settings.model, bool(self._prediction.positions_mm)
        least = limits.keep_confidence if alive else limits.min_confidence
        self._touches, inferred = self._place(detection, least, complete, begun)
        outcome = Outcome.INFERRED if inferred else Outcome.TRACKED if tracked else Outcome.FAINT
        touches = self._beside.add(detection, self._touches, self._classifier.palm.area, self._touch_maker, limits)
        return Localization(outcome, touches, self._departure, self._plate_moved, self._classifier.palm.covers)

    def _place(
        self, detection: Detection, min_confidence: float, complete: bool, begun: Fitted | None
    ) -> tuple[tuple[Touch, ...], bool]:
        """Return the fingers of a frame, and whether the network ran."""
        noise, search, t_ns = self._noise, self._search, detection.t_ns
        tracked, inferred, held = bool(self._prediction.positions_mm), False, False
        self._touched, self._departure, self._plate_moved = True, False, False
        if begun:
            bins, fit = begun
        else:
            bins = self._plate.bins(detection.residual, detection.hits)
            signal = bins.energy - noise.noise_energy
            # Most tracked fingers are far above noise and drift: that is quickly asked.
            if not (tracked and signal > noise.noise_energy + self._drift.energy) and self._is_untouched(
                bins, 0.0 if tracked else noise.plate_energy(bins.vector), t_ns
            ):
                return self._lose(), inferred
            held = tracked and self._follower.waits(bins, signal)
            if tracked:
                fit = (self._follower.expected if held else self._follower.follow)(bins, t_ns, signal)
            elif search.pending and not (search.doubts and signal > CRITERIA.faint * noise.noise_energy):
                fit = no_fit(bins.energy)  # the search that goes on finds where to begin
            else:
                inferred = True
                fit = self._landing.fit(detection, bins, signal)
            bins, fit = self._follower.settle(self._plate, detection.hits, bins, fit, shaped=not held)
        self._follower.drop()
        if tracked and detection.sounds and not held:
            noise.hear(self._solver.residual(bins, fit, self._follower.shapes_of(fit)), t_ns)
        signal, excess, confidence = noise.judge(bins, fit)
        if excess > CRITERIA.search_above and (less := self._feet.take_out(detection, bins, fit, tracked=tracked)):
            held, (bins, fit) = False, less
            signal, excess, confidence = noise.judge(bins, fit)
        if tracked and excess > CRITERIA.fair and (gone := self._landing.elsewhere(
            detection, bins, signal, self._prediction.positions_mm
        )):  # fmt: skip
            search.cancel()
            held, inferred, fit = False, True, gone
            signal, excess, confidence = noise.judge(bins, fit)
        clear = excess <= CRITERIA.search_above and signal >= CRITERIA.faint * noise.noise_energy
        if tracked and clear and confidence >= min_confidence and not search.pending:  # the usual case
            self._model_fit.add(fit.residual_energy - noise.noise_energy, signal, noise.noise_energy)
            return self._accept(bins, fit, confidence, excess, t_ns, alone=complete), False
        if tracked and excess > CRITERIA.fair and self._is_untouched(bins, noise.plate_energy(bins.vector), t_ns):
            return self._lose(), inferred
        rest = self._follower.rest(bins, fit) if excess > CRITERIA.fair else None
        if rest and self._plate.explains(rest, noise.plate_energy(rest.vector), t_ns):
            # The plate has moved, at once or while nobody could tell, and the contacts have not.
            held, bins = False, self._plate.bins(detection.residual, detection.hits)
            if tracked:
                fit = self._follower.follow(bins, t_ns, bins.energy - noise.noise_energy)
                self._follower.drop()
            else:
                fit = self._solver.fit_one(bins, *fit.positions_mm[0], FIRST_STEPS)
            bins, fit = self._follower.settle(self._plate, detection.hits, bins, fit, shaped=not tracked)
            signal, excess, confidence = noise.judge(bins, fit)
        # From the next frame on a search begins for what may be beside one well explained finger that has just landed.
        if not (tracked or complete) and len(fit.positions_mm) == 1 and excess < CRITERIA.fair:
            search.cancel()  # it began with a frame that was not like this
        elif search.is_due(excess, signal):
            if not search.pending and self._plate.drop_silent(detection):
                bins = self._plate.bins(detection.residual, detection.hits)
                fit = self._solver.fit_one(bins, *fit.positions_mm[0], FIRST_STEPS) if fit.positions_mm else fit
            else:
                found, known = search.search(bins, fit, signal, tracked=tracked, limited=not complete)
                found = found if tracked else self._landing.or_one(bins, found)
                if tracked and self._follower.waits(bins, signal, excess):
                    return self._touches, inferred
                if held and found is fit:
                    found = self._follower.follow(bins, t_ns, signal)
                    self._follower.drop()
                bins, fit = self._follower.settle(self._plate, detection.hits, bins, found)
                if not known:
                    self._prediction.forget_velocities()
            signal, excess, confidence = noise.judge(bins, fit)
        if fit.positions_mm or inferred or not search.pending:
            self._model_fit.add(fit.residual_energy - noise.noise_energy, signal, noise.noise_energy)
        # A silent emitter, or another gain, looks like a finger there; but the plate's directions explain it better.
        faint = signal < CRITERIA.faint * noise.noise_energy
        doubtful = faint or excess > (CRITERIA.good if tracked else CRITERIA.enough)
        by_plate = doubtful and bins.energy - noise.plate_energy(bins.vector) < fit.residual_energy
        by_palms = excess > CRITERIA.fair and signal > CRITERIA.most_poor * self._drift.signal_energy and not tracked
        unlikely = by_plate or by_palms or not confidence >= min_confidence or not fit.positions_mm
        if unlikely or (not tracked and self._landing.is_implausible(bins, fit, signal, excess)):
            self._classifier.palm.miss(fit, excess, signal, t_ns, rings=detection.rings)
            return self._lose(), inferred
        return self._accept(bins, fit, confidence, excess, t_ns, alone=complete), inferred

    def _is_untouched(self, bins: Bins, plate_energy: float, t_ns: int) -> bool:
        """Return whether noise and the plate's own movement explain a frame, and if so follow that movement."""
        if explained := self._plate.explains(bins, plate_energy, t_ns):
            self._search.cancel()
            self._plate_moved = self._plate.moved
        return explained

    def _accept(
        self, bins: Bins, fit: Fit, confidence: float, excess: float, t_ns: int, *, alone: bool
    ) -> tuple[Touch, ...]:
        """Track the fingers of a fit, and return them as touches."""
        if excess < CRITERIA.good and self._drift.is_due(t_ns):
            self._drift.update(self._solver.residual(bins, fit, self._follower.shapes_of(fit)), t_ns)
        self._prediction.update(fit.positions_mm, t_ns)
        if new := self._follower.update(bins, fit, excess):
            self._faces = self._size.faces(fit) if fit.shapes else [None] * len(fit.positions_mm)
        doubt = self._follower.is_in_doubt(t_ns)
        fingers = self._classifier.fingers(
            bins, fit, excess, t_ns, alone=alone, lacking=self._search.explains, beside_mm=self._beside.place_mm
        )
        if self._settings.skip.still:  # not what may be water that a finger has left: each frame must tell
            moved_mm = self._prediction.moved_mm if self._classifier.sure and not doubt else math.inf
            self._still.update(bins, fit, moved_mm, self._noise.variance)
        self._departure = self._classifier.departure
        change = self._plate.change(self._pursuit.mean_energy)
        sure = [finger for finger in fingers if finger[1] <= self._settings.model.max_sigma_mm]
        at, sure = self._refinement.place(bins, fit, sure, self._noise.variance, new=new, alone=alone)
        self._search.look(bins, fit, self._refinement.misfit)
        confidence = min(confidence, self._classifier.likelihood)
        return self._touch_maker.touches(at, sure, None if doubt else self._faces, confidence, change)

    def _rests(self, detection: Detection) -> bool:
        """Return whether the last fit's finger is where it was, but for the noise, and no search for others goes on."""
        if not self._touches or self._search.pending or not self._still.holds(detection, self._plate):
            return False
        self._prediction.rest(detection.t_ns)
        return True

    def _lose(self) -> tuple[Touch, ...]:
        self._plate.nuisance.forget_fingers()
        for part in (self._prediction, self._follower, self._refinement):
            part.reset()
        return ()
