"""Runs a pipeline between a source and its sinks: state, time, and an orderly end."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import structlog

from touchd import __version__
from touchd.config.schema import Settings
from touchd.event import Event, State
from touchd.frame import Frame
from touchd.keypad import Layout
from touchd.localization.model import Model
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline, Result
from touchd.service.control import Control
from touchd.service.frame_feed import FrameFeed
from touchd.service.messages import Health, Messages
from touchd.service.preroll import PreRoll
from touchd.service.rate import ScanRate
from touchd.service.realtime import Awake
from touchd.service.reload import Reloader
from touchd.service.runner import frames_of
from touchd.service.systemd import Notifier
from touchd.sinks.sink import Sink
from touchd.sources.source import Change, Source, Tally

STALL_NS = 1_000_000_000
"""A source that is no device has stalled after this time without a frame, ns."""
_FLOWING: tuple[State, ...] = ("streaming", "uncalibrated")
"""Frames flow."""
_TICK_NS, _IDLE_TICK_NS = 4_000_000, 100_000_000
"""Sinks are polled this often, and all else is done that is due: after each frame of a touch, and every fifth of an
idle plate. Polling costs a fifth of an idle frame."""
_UNHEARD_NS = 10_000_000_000
"""Health messages that nobody wants are this rare: one costs as much as ten idle frames."""
_CONTROL_NS = 50_000_000
"""Commands are read this often: reading costs half as much as an idle frame."""

log = structlog.get_logger()


class Service:
    """The loop from the source's `read` to the sinks' `publish`; it closes them at the end of `run`.

    The pipeline is of this source and these settings, which `read_settings` reads again for `reload`. `feed` hands
    frames to programs that ask for them through `control`, and describes the plate for its messages.
    """

    def __init__(
        self,
        source: Source,
        sinks: Sequence[Sink],
        settings: Settings,
        pipeline: Pipeline,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        manager: Notifier | None = None,
        preroll: PreRoll | None = None,
        control: Control | None = None,
        read_settings: Callable[[], Settings] | None = None,
        feed: FrameFeed | None = None,
    ) -> None:
        self.pipeline = pipeline
        self._source, self._sinks = source, sinks
        # With one sink, its own method: the question comes with each touched frame.
        wants = sinks[0].wants if len(sinks) == 1 else lambda topic: any(sink.wants(topic) for sink in sinks)
        self._messages = messages = Messages(settings, wants)
        self._health = health = Health(source, pipeline, messages, settings.health)
        self._reloader: Reloader | None = None
        if read_settings is not None:
            self._reloader = Reloader(settings, read_settings, pipeline, messages, health, preroll)
        self._clock = clock
        self._manager = manager or Notifier()
        self._awake = Awake(settings.realtime.awake_from_hz)
        self._rate = ScanRate(source, settings.device)
        self._preroll, self._control, self._feed = preroll, control, feed
        self._withheld: dict[str, int] = {}
        self._state: State = "starting"
        self._flowing: State = "streaming" if pipeline.model else "uncalibrated"
        self._reason: str | None = None
        self._away = False
        self._described: tuple[Model | None, Layout | None] | None = None
        self.stopped = False
        """Whether `stop` was called."""
        self._reload_asked = False
        self._seen_ns = self._stream_ns = 0
        self._health_ns = self._control_ns = self._tick_ns = 0

    def stop(self) -> None:
        """End `run` after the current frame; safe to call from a signal handler."""
        self.stopped = True

    def reload(self) -> None:
        """Reload the configuration after the current frame; safe to call from a signal handler."""
        self._reload_asked = True

    def run(self) -> None:
        """Process frames until the source ends or `stop` is called; then lift the contacts and close the sinks."""
        log.info("starting", model=self._health.model_name, version=__version__)
        self._seen_ns = self._clock()
        self._publish_health()
        self._publish_plate()
        try:
            if not self.stopped:
                self._run_frames()
        finally:
            self._manager.stopping()
            for sink in self._sinks:
                sink.poll()  # a subscriber that came just now gets the last messages, too
            self._release(self._clock())
            self._enter("stopping")
            self._awake.close()
            self._source.close()
            if self._feed is not None:
                self._feed.close()
            for sink in self._sinks:
                sink.close()

    def _run_frames(self) -> None:
        pipeline, preroll, feed, rate = self.pipeline, self._preroll, self._feed, self._rate
        source = self._source
        labelled = source.labelled
        for frame in frames_of(source, on_change=self._follow):
            if frame is None:
                self._wait()
            else:
                if self._state != self._flowing:
                    self._enter(self._flowing)
                result = pipeline.process(frame)
                if result.contacts or result.touches:
                    self._publish(result, frame.received_ns)
                if labelled and (true := self._messages.truth(frame, source)) is not None:
                    self._hand(true, frame.received_ns)
                if preroll is not None:
                    preroll.keep(frame, result.contacts)
                if feed is not None and feed.listeners:
                    feed.send(frame)
                if result.outcome is not Outcome.UNTOUCHED:
                    rate.touched(frame.t_ns, result.outcome)
                self._finish(frame)
            if self.stopped:
                return
        log.info("end of stream", frames=pipeline.counters.frames)

    def _finish(self, frame: Frame) -> None:
        """Do what is due after a frame, which never waits: a new subscriber gets the next one."""
        period_ns = frame.t_ns - self._stream_ns
        self._stream_ns = frame.t_ns
        self._seen_ns = now_ns = frame.received_ns
        touched = self.pipeline.touched
        if now_ns - self._tick_ns >= (_TICK_NS if touched else _IDLE_TICK_NS):
            self._tick(now_ns)
        self._awake.update(touched, period_ns)

    def _wait(self) -> None:
        """Do what is due while no frame comes."""
        if self._preroll is not None:
            self._preroll.poll()
        now_ns = self._clock()
        # A device reports its states; of any other source only the silence is known.
        if self._source.tally is not None:
            self._count_withheld(self._source.tally, now_ns)
        elif self._state in _FLOWING and now_ns - self._seen_ns > STALL_NS:
            self._release(now_ns)
            self._enter("stalled")
        self._tick(now_ns)
        if not self.pipeline.touched:
            self._awake.close()

    def _count_withheld(self, tally: Tally, now_ns: int) -> None:
        """Tell the pipeline of frames that the source has withheld since the last wait: they measure nothing."""
        withheld, before = dict(tally.withheld), self._withheld
        self._withheld = withheld
        for name, count in withheld.items():
            if count != before.get(name, 0):
                reason = f"the DAQ measures nothing: {name.replace('_', ' ')}"
                self._publish(self.pipeline.withheld(now_ns, reason), now_ns)

    def _tick(self, now_ns: int) -> None:
        self._tick_ns = now_ns
        for sink in self._sinks:
            sink.poll()
        quiet_ns = now_ns - self._health_ns
        if quiet_ns >= self._health.period_ns and (quiet_ns >= _UNHEARD_NS or self._messages.wants("health")):
            self._publish_health()
        followed = self._feed is not None and bool(self._feed.listeners)
        self._rate.wanted = followed or self.pipeline.needs_all_frames
        self._rate.tick(self._stream_ns)
        if self._control is not None and now_ns - self._control_ns >= _CONTROL_NS:
            self._control_ns = now_ns
            self._obey(self._control, now_ns)
        if self._reload_asked:
            self._read_configuration()
        # Here, between frames: a stage, a sink or a source that hangs starves the watchdog.
        self._manager.beat(now_ns)

    def _obey(self, control: Control, now_ns: int) -> None:
        for command in control.poll():
            if command == "reload":
                self._reload_asked = True
            elif command != "frames":
                self._set_screen(off=command == "screen off", now_ns=now_ns)
            elif self._feed is not None:
                self._feed.add(control.listeners.pop(0))

    def _read_configuration(self) -> None:
        self._reload_asked = False
        if self._reloader is not None:
            self._manager.reloading()
            refused = self._reloader.reload()
            self._manager.reloaded()
            self._flowing = "streaming" if self.pipeline.model else "uncalibrated"
            self._publish_plate()
            if self._feed is not None:
                self._feed.configured()
            if self._control is not None:
                model = self.pipeline.model
                self._control.answer(refused, model.path if model else None)

    def _set_screen(self, *, off: bool, now_ns: int) -> None:
        before = self.pipeline.screen_off
        self._publish(self.pipeline.set_screen(off=off), now_ns)
        if self.pipeline.screen_off != before:
            if before:
                self._rate.wake()
            log.info("screen", state="off" if off else "on")
            self._publish_health()

    def _release(self, now_ns: int) -> None:
        """Lift all contacts: without frames nobody knows where the fingers are."""
        self._publish(self.pipeline.release(self._stream_ns), now_ns)

    def _publish(self, result: Result, received_ns: int) -> None:
        event = None
        for event in self._messages.make(result, self.pipeline.spectrum):
            self._hand(event, received_ns)
        if event is not None:
            self._health.add_latency((self._clock() - received_ns) * 1e-3)

    def _hand(self, event: Event, received_ns: int) -> None:
        for sink in self._sinks:
            sink.publish(event, received_ns)

    def _follow(self, change: Change) -> None:
        """Enter the state of a device; one that was away has its plate relearned."""
        if change.state != "streaming":
            self._release(self._clock())
            self._away |= change.state == "lost" and self._stream_ns > 0
        elif self._away:
            self._away = False
            self.pipeline.reset()
        self._enter(self._flowing if change.state == "streaming" else change.state, change.reason)

    def _enter(self, state: State, reason: str | None = None) -> None:
        say = log.warning if state in ("stalled", "lost") else log.info
        say("state", state=state, was=self._state, **({"reason": reason} if reason else {}))
        self._state, self._reason = state, reason
        self._publish_health()

    def _publish_health(self) -> None:
        now_ns = self._health_ns = self._clock()
        late_ns = self._seen_ns - self._stream_ns if self._stream_ns else 0
        event = self._health.message(now_ns, self._stream_ns, self._state, self._reason, late_ns)
        self._hand(event, now_ns)
        self._manager.tell(event)
        self._health.log_losses(event)

    def _publish_plate(self) -> None:
        """Describe the plate to subscribers, unless model and keys are as they were described."""
        described = (self.pipeline.model, self.pipeline.layout)
        if self._feed is not None and described != self._described:
            self._described, now_ns = described, self._clock()
            self._hand(self._messages.plate(self._feed.describe(), self.pipeline.layout, now_ns), now_ns)
