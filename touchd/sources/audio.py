"""An audio interface as a DAQ: the chirp is played again and again, and the mean of some periods is one frame.

Samples are counted from the start on, so frames keep their distance from the chirp as long as none is missing. The
delay from playback to capture is found at each start, see `touchd.audio.delay`: its whole samples move the cut, its
fraction the chirp that is played. An xrun, or a response that is suddenly another, begins that again; the frames that
this costs are withheld, and counted by reason.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

import numpy as np
import structlog

from touchd.audio.capture import Capture, HighPass, Watch, check_band, periods_of, rates_of
from touchd.audio.card import Card, CardAbsent, CardGone, CardXrun, Floats, Samples, loop_of, moved
from touchd.audio.delay import Delay, Doubtful, by_loopback, by_onset, by_reference, check_discs
from touchd.config.rigs import AudioSettings
from touchd.config.schema import DeviceSettings, Settings
from touchd.errors import ConfigError
from touchd.frame import Acquisition, Chirp
from touchd.localization.model import Model
from touchd.recording.data import Device
from touchd.sources.daq import Daq, DaqAbsent, DaqFrame, DaqGone
from touchd.sources.device_clock import MAX_SKEW
from touchd.sources.live import DaqSource

MEASURED, MEASURED_S = 8, 0.06
"""Periods whose mean tells the delay, at least, and how long they last, at least."""
SETTLE_S = 0.05
"""Ringing of the plate, and what converters delay, between a change of what is played and the first measured period."""
DOUBT_S = 0.5
"""Until then a start is measured again if no delay is certain: converters mute themselves while they start."""
START_S = 1.0
"""A card that brings no frame for this long after its start will bring none: the delay is found by then."""
BUS_S = 0.03
"""How long samples take over a USB bus and through converters at a start, at most: the kernel queues 18 ms of them."""
STILL_SAMPLES = 5e-4
"""A smaller fraction is left as it is."""
_MOST_MOVES = 3
_ALIVE = 0.5
"""Correlation with the reference, and of the periods of a measurement with each other, of a channel that hears."""
_STEADY = 0.995
"""The latter of a channel that is watched: of one that is noisier, some frames differ as much as if it were lost."""

log = structlog.get_logger()


def acquisition_of(settings: AudioSettings) -> Acquisition:
    """Return the geometry of an audio interface's frames: one chirp follows the other, and a frame is a period."""
    rate_hz = settings.sample_rate_hz
    chirp = Chirp(
        start_hz=settings.band_hz[0], stop_hz=settings.band_hz[1], duration_s=settings.chirp_s, dac_rate_hz=rate_hz,
        period_s=settings.chirp_s,
    )  # fmt: skip
    return Acquisition(
        channels=len(settings.channels), samples=round(settings.chirp_s * rate_hz), sample_rate_hz=rate_hz,
        full_scale_v=1.0, chirp=chirp,
    )  # fmt: skip


def rate_of(acquisition: Acquisition, settings: DeviceSettings) -> int:
    """Return the frame rate that is set; if none is, the one nearest to the default that whole chirps fill, Hz."""
    default_hz = settings.rate_hz
    if "rate_hz" in settings.model_fields_set:
        return default_hz
    return min(rates_of(acquisition), key=lambda rate_hz: abs(rate_hz - default_hz), default=default_hz)


class AudioDaq(Daq):
    """The `Daq` over an open card, which plays until it is closed.

    `reference` is the untouched response that the model was made from, shape (channels, samples). Without one, frames
    keep the delay that they had to the response of an `earlier` connection, where this is the same plate.
    """

    def __init__(
        self,
        card: Card,
        settings: AudioSettings,
        acquisition: Acquisition,
        reference: Floats | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        earlier: Floats | None = None,
    ) -> None:
        self.acquisition = acquisition
        self.device = Device(serial=card.name)
        self.max_rate_hz = int(acquisition.sample_rate_hz // acquisition.samples)
        self._card, self._settings, self._clock = card, settings, clock
        self._reference, self._earlier = reference, earlier
        self._own: Floats | None = None  # the response at the first delay that was found
        self._inputs = np.array([at - 1 for at in (*settings.channels, settings.loopback) if at])
        self._discs = len(settings.channels)
        self._no_counts: Samples = np.zeros(acquisition.shape, np.int16)
        lowest_hz = min(acquisition.chirp.start_hz, acquisition.chirp.stop_hz)
        self._high_pass = HighPass(lowest_hz, acquisition.sample_rate_hz, *acquisition.shape)

    def start(self, rate_hz: int) -> None:
        """Play and capture; frames come once the delay is found."""
        a = self.acquisition
        self._period, chirps = periods_of(a, rate_hz)
        self._measures = max(MEASURED, round(MEASURED_S * a.sample_rate_hz / self._period))
        self._period_us = 1e6 / rate_hz
        self._nominal = loop_of(a.chirp, a.sample_rate_hz, self._period, self._settings.level_dbfs)
        self._capture = Capture(self._inputs, self._period, chirps, self._high_pass.margin)
        self._fraction = 0.0
        self._earlier, self._own = self.response, None
        self._sequence, self._time_us = 0, 0.0  # of the next frame
        self._last_ns = 0  # when the last frame, or one that is withheld, was complete; 0: unknown
        self._xrun, self._cuts, self._every = False, 0, 1
        self._restart()

    def read(self, timeout_s: float) -> DaqFrame | None:
        """Return the next frame, or one that is withheld; None if none is complete in time."""
        if not self._capture.has(self._needed):
            try:
                block = self._card.exchange(timeout_s)
            except CardXrun as xrun:
                if not self._xrun:  # a burst is told once
                    log.warning("xrun", why=str(xrun))
                self._xrun = True
                self._restart()
                return None
            except CardGone as gone:
                raise DaqGone(str(gone)) from gone
            if block is None:  # a card that is silent sends no periods, not even lost ones: it stalls
                return None
            self._capture.append(block)
            if not self._capture.has(self._needed):
                return self._withhold()
        if self._aligned:
            self._cuts += 1
            if self._xrun or not self._cuts % self._every:
                return self._cut()
            self._capture.skip_frame()
            self._count()
            return None
        self._measure()
        return self._withhold()

    def set_rate(self, rate_hz: int) -> None:
        """Pass on every n-th frame: the chirps go on, since a response in steady state belongs to their period."""
        self._every = max(1, round(1e6 / (rate_hz * self._period_us)))

    @property
    def response(self) -> Floats | None:
        """What the discs of this or an earlier connection heard, shape (channels, samples), by which frames are cut."""
        return self._earlier if self._own is None else self._own

    def close(self) -> None:
        """Release the card; never fails."""
        self._card.close()

    def _restart(self) -> None:
        """Start the card, then find the delay."""
        try:
            self._card.start(moved(self._nominal, -self._fraction))
        except CardGone as gone:
            raise DaqGone(str(gone)) from gone
        self._capture.reset()
        self._moves = 0
        self._settle(round(BUS_S * self.acquisition.sample_rate_hz))

    def _settle(self, ahead: int) -> None:
        """Measure the delay in periods that hold nothing of what was played before, so many samples ahead."""
        self._capture.skip(ahead + round(SETTLE_S * self.acquisition.sample_rate_hz), whole_periods=True)
        self._sums, self._measured = np.zeros((2, len(self._inputs), self._period)), 0  # of every other period
        self._aligned, self._needed = False, self._period

    def _measure(self) -> None:
        """Add a period to those that tell the delay; the last one does."""
        self._sums[self._measured % 2] += self._capture.take()
        self._measured += 1
        if self._measured == self._measures:
            try:
                self._align(self._sums.sum(axis=0) / self._measures)
            except CardGone as gone:
                raise DaqGone(str(gone)) from gone
            except Doubtful as doubt:
                if self._capture.passed > DOUBT_S * self.acquisition.sample_rate_hz:
                    raise DaqGone(str(doubt)) from doubt
                self._settle(0)

    def _align(self, mean: Floats) -> None:
        """Cut where the response to a chirp begins, and play the chirp so that it begins with a sample."""
        check_band(mean[: self._discs], self._nominal, self._card.rate_hz)
        mean = self._high_pass.around(mean)
        found = self._find(mean)
        whole = round(found.samples)
        if abs(fraction := found.samples - whole) > STILL_SAMPLES and self._moves < _MOST_MOVES:
            self._moves += 1
            self._fraction += fraction
            self._card.play(moved(self._nominal, -self._fraction))
            self._settle(self._card.ahead)
            return
        log.info("delay found", samples=whole % self._period, explained=round(found.explained, 4))
        if self._own is None:
            self._own = moved(mean[: self._discs], -whole)[:, : self.acquisition.samples]
            steady = self._steady()
            if not self._settings.loopback:
                steady[np.abs(found.channels) < _ALIVE] = 0
            self._watch = Watch(self._own, steady > _STEADY)
            if silent := [self._settings.channels[i] for i in np.flatnonzero(steady < _ALIVE)]:
                log.warning("inputs hear nothing of the chirp", inputs=silent)
        self._capture.skip(whole, whole_periods=False)
        self._aligned, self._needed = True, self._capture.needed(self.acquisition.samples)

    def _find(self, mean: Floats) -> Delay:
        discs, a = mean[: self._discs], self.acquisition
        # After an xrun, the response that the baseline was learned from.
        reference = self._reference if self._own is None else self._own
        if self._settings.loopback:
            check_discs(discs, reference)
            return by_loopback(mean[self._discs], self._nominal)
        if reference is not None:
            return by_reference(discs, reference, a.chirp, a.sample_rate_hz)
        if self._earlier is not None:
            with contextlib.suppress(Doubtful):
                return by_reference(discs, self._earlier, a.chirp, a.sample_rate_hz)
        return by_onset(discs, self._nominal)

    def _steady(self) -> Floats:
        """Return the correlation of every other period with those between them, shape (channels,)."""
        even, odd = self._high_pass.around(self._sums[:, : self._discs])
        energy = np.square(even).sum(axis=1) * np.square(odd).sum(axis=1)
        return np.asarray((even * odd).sum(axis=1) / np.sqrt(np.maximum(energy, 1e-30)))

    def _cut(self) -> DaqFrame:
        """Return the next frame."""
        if self._xrun:  # periods have gone by, whose number only the clock knows
            gone = (self._clock() - self._last_ns) / 1e3
            self._xrun, self._last_ns = False, 0
            self._sequence += max(round(gone / self._period_us), 1) - 1
            self._time_us += max(gone - self._period_us, 0.0)
        counts = self._high_pass.apply(self._capture.frame(self.acquisition.samples)[: self._discs])
        clipped = self._high_pass.clips(counts)
        if lost := self._watch.lost(self._high_pass.filtered):
            which = ", ".join(str(self._settings.channels[i]) for i in lost)
            raise DaqGone(f"input {which} no longer hears the chirp as before: lost samples, a cable, a knob or a mute")
        frame = DaqFrame(counts, self._sequence, round(self._time_us), clipped)
        self._sequence += 1
        self._count()
        return frame

    def _count(self) -> None:
        """Count a period: read late, it was complete a period after the last one, and the card's clock may be slow."""
        self._time_us += self._period_us
        now_ns, next_ns = self._clock(), self._last_ns + round(1e3 * self._period_us * (1 + MAX_SKEW))
        self._last_ns = min(now_ns, next_ns) if self._last_ns else now_ns

    def _withhold(self) -> DaqFrame | None:
        """Return one frame for each period that goes by after an xrun; before the first frame none is missing."""
        if not self._xrun or not self._last_ns or self._clock() - self._last_ns < 1e3 * self._period_us:
            return None
        frame = DaqFrame(self._no_counts, self._sequence, round(self._time_us), withheld="xrun")
        self._last_ns += round(1e3 * self._period_us)
        self._sequence += 1
        self._time_us += self._period_us
        return frame


Opener = Callable[[str, int, int], Card]
"""Opens a card of a name, at a sample rate, with so many inputs; raises CardAbsent."""


def open_audio(
    settings: Settings, opener: Opener, name: str, model: Model | None, *, clock: Callable[[], int] = time.monotonic_ns
) -> DaqSource:
    """Return the source of a card that may be plugged in later.

    Raises ConfigError if no card is named, or the frame rate does not fit the sample rate; ModelMismatch if the model
    was made for another acquisition than [audio] says.
    """
    audio = settings.audio
    if not name:
        raise ConfigError("is not set", "audio.device", "name a card: --audio hw:CARD=NAME; arecord -L lists them")
    if not name.isprintable():  # it is said in messages
        raise ConfigError(f"is {name!r}", "audio.device", "name a card as arecord -L lists it")
    acquisition = acquisition_of(audio)
    if model is not None:
        model.check(acquisition)
    changes = {"rate_hz": rate_of(acquisition, settings.device), "stall_s": max(settings.device.stall_s, START_S)}
    device = settings.device.model_copy(update=changes)
    periods_of(acquisition, device.rate_hz)
    reference = model.atlas.baseline.astype(np.float64) if model is not None and model.atlas is not None else None
    last: AudioDaq | None = None

    def connect() -> Daq:
        nonlocal last
        try:
            card = opener(name, audio.sample_rate_hz, max(*audio.channels, audio.loopback))
        except CardAbsent as absent:
            raise DaqAbsent(str(absent)) from absent
        last = AudioDaq(card, audio, acquisition, reference, clock, None if last is None else last.response)
        return last

    return DaqSource(lambda: iter([connect]), device, acquisition, clock=clock, direct=False)
