"""READ FIRST: one frame's way through touchd, from counts to events.

source -> frame -> baseline -> gate -> features -> model -> tracker -> event -> sink

`Pipeline.process` is the middle of that line, stage by stage and with no way back. It knows no
hardware, no socket and no clock: time is the frames' own, so a recording gives the same events at any
speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from msgspec import Struct

from touchd.config.schema import Settings
from touchd.detection.baseline import Baseline
from touchd.detection.gate import Gate
from touchd.detection.relearn import Standing, Verdict
from touchd.detection.stuck import LASTING_FRAMES, Channels, Frozen
from touchd.event import Contact
from touchd.frame import Acquisition, Frame
from touchd.keypad import Layout
from touchd.localization.model import Model
from touchd.localization.network_localizer import finder_for
from touchd.outcome import Counters, Outcome
from touchd.touch import Touch
from touchd.tracking.keys import KeyPress, Keys
from touchd.tracking.tracker import Tracker

_NO_CONTACTS: list[Contact] = []
_NO_KEYS: list[KeyPress] = []
# The baseline moves by at most this much time at once: after a gap it must not swallow a single frame whole.
_LONGEST_STEP_S = 0.1
LATE_FRAMES = 32
"""A frame numbered at most so much lower than the last is a repetition, not a device that starts again."""

TURN_EVERY = 16
"""Of untouched frames; while touched another channel is looked at in each, since one that freezes keeps a finger."""


class Result(Struct, frozen=True, gc=False):
    """What came of a frame."""

    t_ns: int
    """CLOCK_MONOTONIC of the frame, ns."""
    sequence: int
    """The frame's number."""
    outcome: Outcome
    contacts: list[Contact] = _NO_CONTACTS
    """All contacts, including those that ended; empty if no message is due."""
    keys: list[KeyPress] = _NO_KEYS
    """Keys pressed and released."""
    touches: int = 0
    """Fingers placed in this frame; if there are any, a spectrum message is due."""


class Pipeline:
    """All stages between a source and the sinks, for one plate.

    Parameters
    ----------
    acquisition : Acquisition
        The geometry of the frames to come; the model must fit it (ModelMismatch).
    model : Model
    settings : Settings
    layout : Layout, optional
        The keys, in keypad mode.
    notify : callable
        Called when the baseline is relearned, with the reason and fields for the log.
    """

    def __init__(
        self,
        acquisition: Acquisition,
        model: Model,
        settings: Settings,
        layout: Layout | None = None,
        notify: Callable[[str, dict[str, float]], None] = lambda _reason, _fields: None,
    ) -> None:
        model.check(acquisition)
        self.counters = Counters()
        self.baseline = Baseline(acquisition.shape, settings.baseline)
        self.gate = Gate(settings.gate)
        self.tracker = Tracker(settings.tracker)
        self._finder = finder_for(model)(acquisition, model, settings, layout, self.baseline, self.gate, self.counters)
        self._standing = Standing(acquisition.shape, settings.baseline)
        self._residual = self.baseline.residual
        self._frozen = Frozen(self.baseline.signal, self._leave_out)
        self.screen_off = False
        """Whether frames only keep the baseline, since nobody sees what is touched."""
        self._keys = Keys()
        self._notify = notify
        self._set_thresholds(settings)
        self._learning = True
        self._signal_energy = 1.0
        self._last_sequence: int | None = None
        self._last_ns = 0
        self.followed_ns = 0
        """Time of the last frame that went into the baseline."""

    def process(self, frame: Frame) -> Result:
        """Take one frame through every stage."""
        if not self._in_order(frame):
            return Result(frame.t_ns, frame.sequence, Outcome.REPEATED)
        if self._frozen.repeats(frame.counts):
            return self._hear_nothing(frame)
        elapsed_s = (frame.t_ns - self._last_ns) * 1e-9
        if not 0.0 <= elapsed_s <= _LONGEST_STEP_S:
            elapsed_s = 0.0 if elapsed_s < 0.0 else _LONGEST_STEP_S
        self._last_ns = frame.t_ns

        if self._learning:
            return self._learn(frame)
        energy = self.baseline.subtract(frame.counts)
        is_open = self.gate.decide(energy)
        if self.screen_off:
            return self._rest(frame, energy, elapsed_s, is_open=is_open)
        if not is_open:
            # What lets features and network be skipped: noise alone explains the frame, whatever they would say of it.
            if self._skip.gate:
                self.counters.skipped["gate"] += 1
            else:
                self._look_all_the_same(energy)
            self._untouched(frame, energy, elapsed_s)
            return self._track(frame, (), Outcome.UNTOUCHED)

        self._frozen.turn()
        faint = self._finder.is_faint(energy)
        if faint:
            self.counters.skipped["faint"] += 1
            self._finder.forget()
        touches = () if faint else self._finder.find(energy, elapsed_s, alive=self.tracker.alive)
        result = self._track(frame, touches, Outcome.FAINT if faint else Outcome.TOUCHED)
        self._settle(frame, energy, elapsed_s, found=bool(touches), faint=faint)
        return result

    def noise_counts(self) -> float:
        """Return the RMS of an untouched frame against the baseline, ADC counts; 0 before it is known."""
        return math.sqrt(self.gate.noise_energy / self._residual.size)

    @property
    def fault(self) -> str | None:
        """What is wrong with the frames that come, for a person; None if nothing is known."""
        if self._frozen.frames >= LASTING_FRAMES:
            return "the DAQ repeats one frame"
        channels = np.flatnonzero(self._frozen.channels).tolist()
        return f"the DAQ repeats what it heard on channels {channels}" if channels else None

    @property
    def touched(self) -> bool:
        """Whether a contact is down."""
        return self.tracker.alive

    def spectrum(self) -> list[float]:
        """Return the features of the last frame."""
        return self._finder.spectrum()

    def release(self, t_ns: int) -> Result:
        """End all contacts, since no further frame comes."""
        self._finder.forget()
        contacts = self.tracker.release_all(t_ns) or _NO_CONTACTS
        return Result(t_ns, self._last_sequence or 0, Outcome.STUCK, contacts, self._keys.update(contacts))

    def set_screen(self, *, off: bool) -> Result:
        """Tell whether the screen is off; if it goes off, its contacts end.

        Nobody can mean anything by a touch then: frames only keep the baseline, with neither features nor network.
        """
        if off == self.screen_off or not self._skip.screen:
            return Result(self._last_ns, self._last_sequence or 0, Outcome.SCREEN_OFF)
        self.screen_off = off
        return self.release(self._last_ns)

    def configure(self, settings: Settings, layout: Layout | None) -> None:
        """Take other thresholds, time constants and keys from the next frame on; the baseline and contacts stay."""
        self.baseline.retune(settings.baseline)
        self.gate.retune(settings.gate)
        self.tracker.retune(settings.tracker)
        self._standing.retune(settings.baseline)
        self._finder.retune(settings, layout)
        self._set_thresholds(settings)

    def reset(self) -> None:
        """Relearn the plate: the device was away, and what it hears may have changed."""
        self._notify("reconnected", {})
        self._last_sequence = None
        self._learn_anew()

    def _set_thresholds(self, settings: Settings) -> None:
        self._small = 10 ** (settings.baseline.drift_below_db / 10)
        self._skip = settings.skip
        if not self._skip.screen:
            self.screen_off = False

    # -- the stages that need more than one call ---------------------------------------------------

    def _in_order(self, frame: Frame) -> bool:
        """Count what is missing before a frame; a frame that was seen already is dropped."""
        counters = self.counters
        last = self._last_sequence
        if last is None:
            self._last_ns = frame.t_ns
        elif frame.sequence > last:
            counters.lost += frame.sequence - last - 1
        elif frame.sequence < last - LATE_FRAMES and frame.t_ns > self._last_ns:
            # A low number in a new frame: the device counts from the start again. What it hears may have changed.
            # A little lower is a frame sent twice or come late; a device that restarts so early soon overtakes it.
            self._notify("restarted", {"frame": frame.sequence, "after": last})
            self._learn_anew()
        else:
            counters.repeated += 1
            return False
        self._last_sequence = frame.sequence
        counters.frames += 1
        return True

    def _hear_nothing(self, frame: Frame) -> Result:
        """The frame is the one before, under a new number: it says nothing of the plate, and nothing is learned.

        It is as if none came: when there are several, nobody can know where the fingers are.
        """
        skipped = self.counters.skipped
        skipped["frozen"] = skipped.get("frozen", 0) + 1
        if self._frozen.frames < LASTING_FRAMES:
            return Result(frame.t_ns, frame.sequence, Outcome.STUCK)
        self._standing.clear()
        return self.release(frame.t_ns)

    def _leave_out(self, channels: Channels) -> None:
        """Some channels say nothing of the plate, the others do."""
        self.baseline.leave_out(channels)
        self._finder.leave_out(channels)

    def _learn(self, frame: Frame) -> Result:
        """Learn the untouched plate and its noise before anything is sensed."""
        self.counters.skipped["learning"] += 1
        energies = self.baseline.learn(frame.counts)
        if energies is not None:
            self.gate.learn(energies)
            self._standing.clear()
            self._signal_energy = max(self.baseline.energy(), 1.0)  # a dead DAQ sends zeros
            self._finder.learned()
            self._learning = False
            self.followed_ns = frame.t_ns
        return self._track(frame, (), Outcome.LEARNING)

    def _untouched(self, frame: Frame, energy: float, elapsed_s: float) -> None:
        """The gate is closed: the plate's drift and noise are followed."""
        self._standing.clear()
        if not frame.sequence % TURN_EVERY:
            self._frozen.turn()
        if self.gate.follow(energy):
            self._finder.hear_anew()
        followed = not self.tracker.busy
        if followed:
            self.baseline.follow(elapsed_s)
            self.followed_ns = frame.t_ns
        self._finder.untouched(elapsed_s, followed=followed)

    def _look_all_the_same(self, energy: float) -> None:
        """Nothing is skipped: features and network see an untouched frame, and what they say of it is forgotten."""
        self._finder.find(energy, 0.0, alive=False)
        self._finder.forget()

    def _rest(self, frame: Frame, energy: float, elapsed_s: float, *, is_open: bool) -> Result:
        """What lets all but the baseline be skipped: the screen is off, and no touch can mean anything."""
        self.counters.skipped["screen-off"] += 1
        if is_open:
            # As with anything that is no finger: what stays is absorbed, so that it is none when the screen goes on.
            self._settle(frame, energy, elapsed_s, found=False, faint=True)
        else:
            self._untouched(frame, energy, elapsed_s)
        return Result(frame.t_ns, frame.sequence, Outcome.SCREEN_OFF)

    def _track(self, frame: Frame, touches: tuple[Touch, ...], outcome: Outcome) -> Result:
        contacts = _NO_CONTACTS
        if outcome >= Outcome.TOUCHED or self.tracker.busy:
            contacts = self.tracker.update(frame.t_ns, touches) or _NO_CONTACTS
        return Result(
            frame.t_ns, frame.sequence, outcome, contacts, self._keys.update(contacts) if contacts else _NO_KEYS,
            len(touches),
        )  # fmt: skip

    def _settle(self, frame: Frame, energy: float, elapsed_s: float, *, found: bool, faint: bool) -> None:
        """The gate is open: decide whether the plate as it is now has become the untouched one."""
        finger = found or self.tracker.alive
        if not finger and energy < self._small * self._signal_energy:
            # Less than any finger does: the plate has drifted while it was touched.
            self.baseline.follow(elapsed_s)
            self.followed_ns = frame.t_ns
        leaving = not finger and not faint and self._finder.leaving()
        verdict = self._standing.watch(frame.t_ns, self._residual, energy, finger=finger, leaving=leaving)
        if verdict is not None:
            self._relearn(frame, verdict, energy)

    def _relearn(self, frame: Frame, verdict: Verdict, energy: float) -> None:
        level_db = 10 * math.log10(energy / self._signal_energy)
        self._notify(verdict.value, {"frame": frame.sequence, "level_db": round(level_db, 1)})
        self._learn_anew()

    def _learn_anew(self) -> None:
        self.baseline.restart()
        self._finder.forget()
        self._learning = True
