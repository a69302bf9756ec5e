"""READ FIRST: one frame's way through touchd, from counts to contacts.

source -> frame -> detect -> follow or clean and localize -> track -> adapt -> result -> message -> sink

`Pipeline.process` is the middle of that line. It knows no hardware, no socket, no message and no clock: time is the
frames' own, so a recording gives the same contacts at any speed.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from touchd.config.schema import Settings
from touchd.detection.baseline import Signal
from touchd.detection.detection import Detection
from touchd.detection.detector import Detector, Notify
from touchd.event import Contact
from touchd.frame import Acquisition, Frame
from touchd.keypad import Layout
from touchd.localization.localization import RINGS, SETTLES_NS, Localization
from touchd.localization.localizer import make_localizer
from touchd.localization.model import Model
from touchd.outcome import Counters, Outcome
from touchd.tracking.keys import KeyPress, Keys
from touchd.tracking.tracker import Tracker

SCREEN_OFF = Localization(Outcome.SCREEN_OFF)
# Bound once: they are asked for in every frame.
_LEARNING, _UNTOUCHED, _TOUCHED = Outcome.LEARNING, Outcome.UNTOUCHED, Outcome.TOUCHED
_NO_CONTACTS: list[Contact] = []
_NO_KEYS: list[KeyPress] = []


class Result(Struct, gc=False, frozen=True):
    """What came of one frame."""

    t_ns: int
    """Time of the frame."""
    sequence: int
    """Its number."""
    outcome: Outcome
    contacts: list[Contact] = []
    """All contacts alive and those that ended in this frame, if a message is due; else none."""
    keys: list[KeyPress] = []
    touches: int = 0
    """Fingers placed in this frame."""


class Pipeline:
    """All stages between a source and the sinks, for one plate.

    The model must fit the geometry of the frames (ModelMismatch), and its type of number is that of all arrays. Without
    one nothing is placed until `set_model`. `layout` has the keys, in keypad mode. `notify` is called with a reason and
    fields for the log when the baseline is relearned or another pane's chirp is found.
    """

    def __init__(
        self,
        acquisition: Acquisition,
        model: Model | None,
        settings: Settings,
        layout: Layout | None = None,
        notify: Notify = lambda _reason, _fields: None,
    ) -> None:
        if model is not None:
            model.check(acquisition)
        self.model = model
        self.layout = layout
        """The keys, in keypad mode."""
        self.counters = Counters()
        self._acquisition = acquisition
        self.detector = Detector(acquisition, settings, notify, model.dtype if model else np.float32)
        self._localizer = make_localizer(model, settings, layout)
        self._tracker = Tracker(settings.tracker)
        self._keys = Keys()
        self._skip = settings.skip
        self.screen_off = False
        """Whether frames only keep the baseline, since nobody sees what is touched."""
        self._detection: Detection | None = None
        self._noise_channels: list[float] = []
        self._rang_ns = -SETTLES_NS

    def process(self, frame: Frame) -> Result:
        """Take one frame through every stage, and count it, the only place where that is done."""
        detection = self.detector.detect(frame)  # is it a measurement, and is the plate touched?
        tracker, found = self._tracker, None
        if detection.outcome is _TOUCHED:
            # The fingers followed explain most frames: only in the others interference is looked for.
            found = self._localizer.follow(detection) if tracker.alive and not self.screen_off else None
            if found is None:
                detection = self.detector.clean(detection)
        self._detection, outcome = detection, detection.outcome
        if outcome <= _LEARNING:  # repeated, stuck, learning: says nothing of fingers
            found, contacts = Localization(outcome), self._without_measurement(detection)
        else:
            if outcome is _UNTOUCHED:
                found = self._localizer.observe(detection)  # noise and temperature of the untouched plate
                if self.screen_off or not self._skip.gate:
                    found = self._without_skips(detection)
            elif self.screen_off:
                found = SCREEN_OFF
            elif found is None:
                found = self._localizer.localize(detection, alive=tracker.alive)
                if found is RINGS:
                    self._rang_ns = frame.t_ns
            touches = found.touches
            if outcome is _TOUCHED and self._rings(frame.t_ns, len(touches)):
                contacts = tracker.hold(frame.t_ns)
            else:
                contacts = tracker.track(frame.t_ns, touches, found.palm) if touches or tracker.tracks else _NO_CONTACTS
            moving = any(contact.phase != "hold" for contact in contacts) if contacts else False
            # Follow, freeze or relearn the baseline: the one feedback.
            self.detector.adapt(
                detection, bool(touches), found.departure, tracker.alive, found.plate_moved, moving,
                asleep=self.screen_off,
            )  # fmt: skip
        counters, outcome = self.counters, found.outcome
        counters.by_outcome[outcome._value_] += 1  # to index by an enum takes four times as long
        if detection.lost:
            counters.lost += detection.lost
        keys = self._keys.update(contacts) if contacts else _NO_KEYS
        return Result(frame.t_ns, frame.sequence, outcome, contacts, keys, len(found.touches))

    def _rings(self, t_ns: int, touches: int) -> bool:
        """Return whether a knock hides fingers: none lifts by it, nor soon after it, until all are found again."""
        return (
            0 <= t_ns - self._rang_ns < SETTLES_NS and touches < len(self._tracker.tracks) and self._tracker.holds(t_ns)
        )

    def release(self, t_ns: int) -> Result:
        """End all contacts because no further frame comes."""
        self._localizer.reset()
        contacts = self._tracker.release_all(t_ns)
        return Result(t_ns, self.detector.sequence, Outcome.REPEATED, contacts, self._keys.update(contacts))

    def withheld(self, t_ns: int, fault: str) -> Result:
        """Take a frame that the source withholds because it is no measurement; `fault` says why, for a person."""
        self.detector.miss(t_ns, fault)
        contacts = self._lift_in_silence(t_ns)
        return Result(t_ns, self.detector.sequence, Outcome.REPEATED, contacts, self._keys.update(contacts))

    def set_screen(self, *, off: bool) -> Result:
        """Switch touches off or on with the screen, and return what ends their contacts.

        With the screen off nobody can mean anything by a touch: frames only keep the baseline.
        """
        t_ns = self._detection.t_ns if self._detection else 0
        if off == self.screen_off or not self._skip.screen:
            return Result(t_ns, self.detector.sequence, Outcome.SCREEN_OFF)
        self.screen_off = off
        return self.release(t_ns)

    def configure(self, settings: Settings, layout: Layout | None) -> None:
        """Take other thresholds, time constants and keys from the next frame on; baseline and contacts stay."""
        self.layout = layout
        self.detector.configure(settings)
        self._localizer.configure(settings, layout)
        self._tracker.configure(settings.tracker)
        self._skip = settings.skip
        self.screen_off &= settings.skip.screen

    def check(self, model: Model) -> None:
        """Raise ModelMismatch if a model was made for another acquisition."""
        model.check(self._acquisition)

    def set_model(self, model: Model, settings: Settings, layout: Layout | None) -> None:
        """Place fingers with another model of the same type of number: the plate is relearned, and contacts end.

        Raises ModelMismatch if it was made for another acquisition.
        """
        self.check(model)
        self._localizer = make_localizer(model, settings, layout)
        self.model, self.layout = model, layout
        self.detector.reset()

    def reset(self) -> None:
        """Relearn the plate: the device was away, and what it hears may have changed."""
        self.detector.reset()
        self._localizer.reset()

    def spectrum(self) -> list[float]:
        """Return the model's input for the last frame."""
        return self._localizer.spectrum(self._detection) if self._detection else []

    @property
    def needs_all_frames(self) -> bool:
        """Whether another pane's chirp is known or looked for: at another frame rate it would be another waveform."""
        other = self.detector.other_chirp
        return not self.screen_off and (other.known or other.listens)

    @property
    def residual(self) -> Signal:
        """Return the last frame less its baseline, shape (channels, samples), valid until the next one."""
        assert self._detection is not None  # after a frame
        return self._detection.residual

    @property
    def stretch(self) -> float | None:
        """Relative rise of the plate's resonances since training; None without a field atlas."""
        return self._localizer.stretch

    def noise_channels(self) -> list[float]:
        """Return the RMS of each channel in the last untouched frame against the baseline, ADC counts."""
        if self._detection is not None and self._detection.outcome is _UNTOUCHED:
            self._noise_channels = self.detector.noise_channels()
        return self._noise_channels

    @property
    def touched(self) -> bool:
        """Whether a contact is down."""
        return self._tracker.alive

    @property
    def model_fit(self) -> float | None:
        """Share of a touch's energy that the model explains, 0..1, median of the last touches; None if unknown."""
        return self._localizer.model_fit

    def _without_measurement(self, detection: Detection) -> list[Contact]:
        """Lift contacts by liveness if the DAQ measures nothing, and by missing touches while the plate is learned."""
        if detection.outcome is not Outcome.LEARNING:
            return self._lift_in_silence(detection.t_ns)
        if detection.learned is not None:
            self._localizer.update(detection.baseline, detection.learned)
        return self._tracker.track(detection.t_ns, ())

    def _lift_in_silence(self, t_ns: int) -> list[Contact]:
        """End all contacts if the last measurement is too old to say where the fingers are."""
        if not self.detector.liveness.fault:
            return _NO_CONTACTS
        self._localizer.reset()
        return self._tracker.release_all(t_ns)

    def _without_skips(self, detection: Detection) -> Localization:
        """Say that the screen is off; with `skip.gate` off localize an untouched frame, to measure what that costs."""
        if self.screen_off:
            return SCREEN_OFF
        outcome = self._localizer.localize(detection, alive=False).outcome
        self._localizer.reset()
        return Localization(outcome)
