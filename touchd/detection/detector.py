"""Is a frame a measurement, and is the plate touched? Front door of the room.

`Detector.detect` numbers the frame, compares it with its predecessor, subtracts the baseline and asks the gate.
`Detector.clean` takes out of a touched frame that the fingers followed do not explain what is no finger.
`Detector.adapt` closes the one feedback: what was found in the frame decides whether the baseline follows the plate,
stays frozen or is relearned.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import DTypeLike

from touchd.config.schema import Settings
from touchd.detection.baseline import Baseline, Signal
from touchd.detection.detection import Detection
from touchd.detection.gate import Gate
from touchd.detection.interference import Interference
from touchd.detection.liveness import Liveness
from touchd.detection.pace import Pace
from touchd.detection.relearn import Reason, Relearn
from touchd.detection.stuck import LONGEST_CYCLE, Stuck
from touchd.detection.tones import LISTEN_EVERY, RENEW_EVERY
from touchd.frame import Acquisition, Frame
from touchd.outcome import Outcome

LATE_FRAMES = 32
"""A frame numbered at most this much lower than the last one is a repetition; a lower number is a device restart."""
DRIFT_SHARE = 1e-5
"""Without a finger, a change below this share of the signal's energy is drift, and the baseline follows it."""
KEEP_EVERY = 16
"""Stuck channels and cycles: the detector watches another channel and keeps another frame after every 16th untouched
frame; another channel after every touched frame, and another frame after every 8th."""

OTHER_CHIRP = "another chirp"
"""What `notify` is called with when another pane's chirp is found."""

_NO_FRAME = -(2**62)
_TOUCHED, _UNTOUCHED = Outcome.TOUCHED, Outcome.UNTOUCHED  # bound once: they are asked for in every frame

Notify = Callable[[str, dict[str, float]], None]


class Detector:
    """Decides what each frame is, and keeps the baseline.

    Parameters
    ----------
    acquisition : Acquisition
    settings : Settings
    notify : callable
        Called with a reason and fields for the log when the baseline is relearned or another pane's chirp is found.
    dtype : type
        Of all arrays.
    """

    def __init__(
        self, acquisition: Acquisition, settings: Settings, notify: Notify, dtype: DTypeLike = np.float32
    ) -> None:
        shape = acquisition.shape
        self.gate = Gate(settings.gate)
        self.liveness = Liveness()
        self._baseline = Baseline(acquisition, settings.baseline, dtype)
        self._interference = Interference(acquisition, self._baseline, self.gate, self._tell_other_chirp, dtype)
        self._tones, self.other_chirp = self._interference.tones, self._interference.other_chirp
        self._relearn = Relearn(shape, settings.baseline, dtype)
        self._stuck = Stuck(shape, dtype)
        self._live = self._stuck.live
        self._notify = notify
        self._pace = Pace()
        self._learning = True
        self._signal_energy = 1.0
        self.sequence = _NO_FRAME
        """Number of the last frame that was not repeated; before the first one, which may have any, far below 0."""
        self._last_ns = 0
        self._alive = False
        self._listened = False
        self.followed_ns = 0
        """Time of the last frame that moved the baseline."""
        self.configure(settings)

    def configure(self, settings: Settings) -> None:
        """Take other thresholds and time constants; baseline and noise stay."""
        self._baseline.configure(settings.baseline)
        self._relearn.configure(settings.baseline)
        self.gate.configure(settings.gate)

    def reset(self) -> None:
        """Relearn the plate from the next frame on, which may have any number: the device was away."""
        self._notify("reconnected", {})
        self.sequence = _NO_FRAME
        self.other_chirp.reset()
        self._learn()

    def detect(self, frame: Frame) -> Detection:
        """Return what a frame is."""
        lost, gate, tones = 0, self.gate, self._tones
        if frame.sequence != self.sequence + 1:
            lost = self._number(frame)
            if lost < 0:
                self.miss(frame.t_ns, "the DAQ's frame number stands still or runs back")
                return self._without_measurement(Outcome.REPEATED, frame, 0)
        pace, step_ns = self._pace, frame.t_ns - self._last_ns
        if not pace.low_ns < step_ns < pace.high_ns and not lost and pace.update(step_ns):
            gate.set_period(pace.period_ns)
            self.other_chirp.restart()
        self.sequence, self._last_ns = frame.sequence, frame.t_ns
        baseline, stuck = self._baseline, self._stuck
        if stuck.repeats(frame.counts, baseline.signal):
            self.miss(frame.t_ns, stuck.fault)
            return self._without_measurement(Outcome.STUCK, frame, lost)
        if stuck.live is not self._live:
            self._live = stuck.live
            baseline.set_channels(self._live)
            self.other_chirp.reset()
        if self._learning:
            return self._learning_frame(frame, lost)
        energy = baseline.subtract(frame.counts, frame.t_ns)
        was_open = gate.is_open
        if self.other_chirp.known:
            self.other_chirp.remove(baseline.residual, frame.sequence)
            energy = baseline.residual_energy()
        if tones.known_hz:
            baseline.keep()  # else what a tone has left in the mean while it was learned would stay there for ever
            if not was_open and not frame.sequence % (RENEW_EVERY * pace.slow_every):
                tones.renew(baseline.residual, gate.noise_energy)
            tones.remove(baseline.residual)
            energy = baseline.residual_energy()
        touched = gate.decide(energy)
        if self._alive:
            self._listened = touched and not frame.sequence % LISTEN_EVERY
            if self._listened and tones.find(baseline.residual, gate.noise_energy):
                energy = baseline.residual_energy()
                touched = gate.decide_again(energy)
            if not touched and gate.is_too_quiet(energy):
                touched = gate.is_open = True  # not the finger has lifted, but a tone has ended that was louder
        if stuck.doubtful or (touched and stuck.returns(energy)):
            self.miss(frame.t_ns, stuck.fault)
            if self.liveness.fault:
                return self._without_measurement(Outcome.STUCK, frame, lost)
        else:
            self.liveness.measured_ns = frame.t_ns
        outcome, changed = (_TOUCHED, False) if touched else (_UNTOUCHED, gate.update(energy))
        return Detection(
            outcome, frame.t_ns, energy, gate.noise_root, gate.noise_deviation, baseline.signal, baseline.residual,
            baseline.mean, self._live, changed, None, lost, pace.period_ns, tones.known_hz,
        )  # fmt: skip

    def clean(self, detection: Detection) -> Detection:
        """Take tones, impulses, hum and knocks out of a touched frame, see `Interference.clean`."""
        return self._interference.clean(detection, listens=not (self._alive and self._listened))

    def adapt(
        self, detection: Detection, found: bool, departure: bool, alive: bool, moved: bool = False,
        moving: bool = False, asleep: bool = False,
    ) -> None:  # fmt: skip
        """Follow, freeze or relearn the baseline, by what came of a measured frame.

        Parameters
        ----------
        detection : Detection
            Of the frame.
        found : bool
            Whether a finger was found in it.
        departure : bool
            Whether the negative of its residual is a finger: one that the baseline held has lifted.
        alive : bool
            Whether a contact is down.
        moved : bool
            Whether its residual is the plate's own movement, which the baseline follows quickly.
        moving : bool
            Whether a contact moves, lands or lifts.
        asleep : bool
            Whether fingers are not looked for.
        """
        self._alive, other = alive, self.other_chirp
        if detection.outcome is _UNTOUCHED:
            if self._relearn.active:
                self._relearn.reset()
                self._tones.end_touch()
            if not self.sequence % KEEP_EVERY:
                self._stuck.keep(detection.signal)
            if not self.sequence % self._pace.slow_every:
                self._interference.update(detection.t_ns, detection.residual)
            if not alive:
                if other.known or other.listens:
                    other.follow(detection.residual, self.sequence, detection.energy, touched=False)
                self._baseline.follow(self.gate.noise_energy)
                self.followed_ns = detection.t_ns
            return
        # Quicker than where there is no finger to hold.
        if self.sequence % LONGEST_CYCLE:
            self._stuck.turn(detection.signal)
        else:
            self._stuck.keep(detection.signal)
            if alive and not detection.hits:
                self._tones.keep(detection.residual)
        finger, energy = found or alive, detection.energy
        if not finger and not asleep:
            other.follow(detection.residual, self.sequence, detection.energy, touched=True)
        if not finger and (moved or energy < DRIFT_SHARE * self._signal_energy):
            # The plate has drifted while it was touched.
            self._baseline.follow(self.gate.noise_energy, quickly=moved)
            self.followed_ns = detection.t_ns
        whole = energy + self._baseline.drive_energy
        departure &= not finger
        reason = self._relearn.update(detection.t_ns, detection.residual, whole, finger, departure, moving)
        if reason is not None:
            level_db = 10 * math.log10(energy / self._signal_energy)
            self._notify(reason.value, {"frame": self.sequence, "level_db": round(level_db, 1)})
            if reason is Reason.LIFTED:  # the rest is known, and the next finger may land at once
                self._baseline.shift(self._relearn.left)
                self._relearn.reset()
            else:
                self._learn(keep_mean=reason is Reason.NOISE)

    def _tell_other_chirp(self, skew_ns: float) -> None:
        clocks_ppm = 1e6 * skew_ns / self._pace.period_ns
        self._notify(OTHER_CHIRP, {"frame": self.sequence, "clocks_ppm": round(clocks_ppm, 1)})

    def noise_counts(self) -> float:
        """Return the RMS of an untouched frame against the baseline, ADC counts; 0 before it is known."""
        return math.sqrt(self.gate.noise_energy / self._baseline.residual.size)

    def noise_channels(self) -> list[float]:
        """Return the RMS of each channel of the last residual, ADC counts."""
        rms: list[float] = np.sqrt(np.square(self._baseline.residual).mean(axis=1)).round(3).tolist()
        return rms

    def miss(self, t_ns: int, fault: str) -> None:
        """Take the time of a frame that is no measurement; `fault` names the fault, for a person."""
        if self.liveness.is_silent(t_ns, fault):
            self._relearn.reset()  # a change on the plate is timed from the next measurement on

    @property
    def fault(self) -> str | None:
        """What is wrong with the frames, for a person; None if nothing is known."""
        if self.liveness.fault:
            return self.liveness.fault
        channels = np.flatnonzero(~self._stuck.live).tolist()
        if channels:
            return f"the DAQ repeats what it heard on channels {channels}"
        return "the signal changes and no finger explains it: interference or water" if self._relearn.restless else None

    def _number(self, frame: Frame) -> int:
        """Return how many frames are missing before a frame; -1 for one whose number is not new."""
        last = self.sequence
        lost = frame.sequence - last - 1
        if last == _NO_FRAME:
            return 0
        if lost < 0:
            if frame.sequence >= last - LATE_FRAMES or frame.t_ns <= self._last_ns:
                return -1
            # A low number in a later frame: the device has restarted, and what it hears may have changed. A number only
            # a little lower is a frame sent twice or late; a device that restarts so early soon overtakes it.
            self._notify("restarted", {"frame": frame.sequence, "after": last})
            self.other_chirp.reset()
            self._learn()
            return 0
        return lost

    def _learning_frame(self, frame: Frame, lost: int) -> Detection:
        """Learn the untouched plate and its noise, before anything is sensed."""
        baseline = self._baseline
        counts, learned = self.other_chirp.take_out(frame.counts, frame.sequence), None
        energies = None if counts is None else baseline.learn(counts, frame.t_ns)
        if energies is not None:
            residuals = baseline.learned()
            if self._tones.learn(residuals):
                energies = baseline.learn_from(baseline.mean + residuals)
            if baseline.learn_sound(residuals := baseline.learned()):
                energies = baseline.learn_from(baseline.mean + residuals)
            hit = self._interference.learn(baseline.window)
            if 0 < 2 * hit.sum() < len(hit):  # where impulses have hit most frames, these stay
                energies = baseline.learn_from(baseline.window[~hit])
            self.gate.learn(energies)
            self._relearn.reset()
            self.other_chirp.end()
            self._signal_energy = baseline.energy()
            self._learning = False
            self.followed_ns = self.liveness.measured_ns = frame.t_ns
            learned = baseline.end(self.gate.noise_energy)
        return self._without_measurement(Outcome.LEARNING, frame, lost, learned)

    def _without_measurement(
        self, outcome: Outcome, frame: Frame, lost: int, learned: Signal | None = None
    ) -> Detection:
        baseline = self._baseline
        return Detection(
            outcome, frame.t_ns, 0.0, self.gate.noise_root, self.gate.noise_deviation, baseline.signal,
            baseline.residual, baseline.mean, self._live, False, learned, lost,
        )  # fmt: skip

    def _learn(self, *, keep_mean: bool = False) -> None:
        self._baseline.reset(keep_mean=keep_mean)
        self.other_chirp.begin()
        self._learning = True
