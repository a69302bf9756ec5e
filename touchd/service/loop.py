"""Runs a pipeline between a source and its sinks: time, state, health, signals, and an orderly end."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Sequence
from types import FrameType

import numpy as np
import structlog

from touchd import __version__
from touchd.config.schema import HealthSettings
from touchd.event import Event, HealthEvent, Latency, State
from touchd.pipeline import Pipeline
from touchd.service.control import Control
from touchd.service.cpu_latency import Awake
from touchd.service.preroll import PreRoll
from touchd.service.systemd import Notifier
from touchd.sinks.messages import Messages
from touchd.sinks.sink import Sink
from touchd.sources.source import Change, EndOfStream, LiveSource, Source, Tally

READ_TIMEOUT_S = 0.05  # how long a new subscriber waits at most for its last value while no frame comes
STALL_NS = 1_000_000_000
_READY: tuple[State, ...] = ("streaming", "lost")
"""Frames flow, or the device is awaited."""
_CONTROL_NS = 50_000_000
"""Commands are looked for this often: a look costs as much as half an idle frame."""
_POLL_NS = 4_000_000
"""Subscribers that have come or gone are looked for this often, at usual rates after each frame: to ask takes a fifth
of the time of an idle frame."""
_LATENCIES = 8192  # kept for one health period; more messages than that a second are sampled by overwriting

log = structlog.get_logger()


class Service:
    """The loop from the source's `read` to the sinks' `publish`.

    Parameters
    ----------
    source, pipeline, sinks, messages
        What it runs; source and sinks are closed at the end.
    settings : HealthSettings
    model_name : str
        For the health messages.
    clock : callable
        Monotonic time, ns.
    manager : Notifier, optional
        The service manager, told of readiness, state and life.
    awake : Awake, optional
        What keeps the processors awake while the plate is touched.
    """

    def __init__(
        self,
        source: Source,
        pipeline: Pipeline,
        sinks: Sequence[Sink],
        messages: Messages,
        settings: HealthSettings,
        model_name: str,
        clock: Callable[[], int] = time.monotonic_ns,
        manager: Notifier | None = None,
        awake: Awake | None = None,
    ) -> None:
        self._source = source
        # A device has states of its own; of any other source only its silence is known.
        self._live = source if isinstance(source, LiveSource) else None
        self._preroll: PreRoll | None = None
        self._control: Control | None = None
        self._control_ns = 0
        self._poll_ns = 0
        self._pipeline = pipeline
        self._sinks = sinks
        self._messages = messages
        self._period_ns = round(settings.period_s * 1e9)
        self._model_name = model_name
        self._clock = clock
        self._manager = manager or Notifier()
        self._awake = awake or Awake(0.0)
        self._state: State = "starting"
        self._reason: str | None = None
        self._away = False
        self._stop = False
        self._reload: Callable[[], HealthSettings] | None = None
        self._reload_asked = False
        self._latencies_us = np.zeros(_LATENCIES, np.float32)
        self._sent = 0
        self._health_ns = 0
        self._seen_ns = 0
        self._stream_ns = 0
        self._logged: dict[str, int] = {}

    def stop(self) -> None:
        """Have `run` end after the frame in hand; safe to call from a signal handler."""
        self._stop = True

    def reload(self) -> None:
        """Have the configuration read again after the frame in hand; safe to call from a signal handler."""
        self._reload_asked = True

    def on_reload(self, read: Callable[[], HealthSettings]) -> None:
        """Name what reads the configuration again, and returns the settings of this part of it."""
        self._reload = read

    def keep(self, preroll: PreRoll) -> None:
        """Have a copy of each frame kept, once its events are published."""
        self._preroll = preroll

    def obey(self, control: Control) -> None:
        """Have commands taken from there."""
        self._control = control

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stop

    def run(self) -> None:
        """Pass frames on until the source ends or `stop` is called; contacts are lifted, sinks flushed."""
        log.info("starting", model=self._model_name, version=__version__)
        self._seen_ns = self._clock()
        self._publish_health()
        try:
            while not self._stop:
                self._step()
        except EndOfStream:
            log.info("end of stream", frames=self._pipeline.counters.frames)
        finally:
            self._manager.stopping()
            for sink in self._sinks:
                sink.poll()  # who subscribed just now hears the end, too
            self._publish(self._pipeline.lose(self._stream_ns), self._clock())
            self._enter("stopping")
            self._awake.close()
            self._source.close()
            for sink in self._sinks:
                sink.close()

    def _step(self) -> None:
        """Take at most one frame, and do what is due beside it."""
        frame = self._source.read(READ_TIMEOUT_S)
        period_ns = 0
        if frame is not None:
            period_ns = frame.t_ns - self._stream_ns
            self._stream_ns = frame.t_ns
            self._seen_ns = frame.received_ns
            if self._state != "streaming":
                self._enter("streaming")
            events = self._pipeline.process(frame)
            if events:
                self._publish(events, frame.received_ns)
            if self._preroll is not None:
                self._preroll.keep(frame, events)
        elif self._preroll is not None:
            self._preroll.poll()
        now_ns = self._clock() if frame is None else frame.received_ns
        # After the frame, which waits for nothing: who has subscribed meanwhile hears of the next one.
        if frame is None or now_ns - self._poll_ns >= _POLL_NS:
            self._poll_ns = now_ns
            for sink in self._sinks:
                sink.poll()
        if frame is None and self._live is not None:
            for change in self._live.changes():
                self._follow(change, now_ns)
        elif frame is None and self._state == "streaming" and now_ns - self._seen_ns > STALL_NS:
            self._publish(self._pipeline.lose(self._stream_ns), now_ns)
            self._enter("stalled")
        if now_ns - self._health_ns >= self._period_ns:
            self._publish_health()
        if self._pipeline.tracker.alive is not self._awake.held:
            self._awake.follow(self._pipeline.tracker.alive, period_ns)
        if self._control is not None and now_ns - self._control_ns >= _CONTROL_NS:
            self._control_ns = now_ns
            for command in self._control.poll():
                self._switch(command == "screen off", now_ns)
        if self._reload_asked:
            self._read_configuration()
        # Here, where every frame comes by: a stage, a sink or a source that hangs starves the watchdog.
        self._manager.beat(now_ns)

    def _read_configuration(self) -> None:
        self._reload_asked = False
        if self._reload is not None:
            self._manager.reloading()
            self._period_ns = round(self._reload().period_s * 1e9)
            self._manager.reloaded()

    def _switch(self, off: bool, now_ns: int) -> None:
        """Take note of whether the screen is off."""
        before = self._pipeline.screen_off
        self._publish(self._pipeline.screen(off=off), now_ns)
        if self._pipeline.screen_off != before:
            log.info("screen", state="off" if off else "on")
            self._publish_health()

    def _publish(self, events: Sequence[Event], received_ns: int) -> None:
        for event in events:
            for sink in self._sinks:
                sink.publish(event, received_ns)
        if events:
            self._latencies_us[self._sent % _LATENCIES] = (self._clock() - received_ns) * 1e-3
            self._sent += 1

    def _follow(self, change: Change, now_ns: int) -> None:
        """Take over a device's state; without frames nobody knows where the fingers are."""
        if change.state != "streaming":
            self._publish(self._pipeline.lose(self._stream_ns), now_ns)
            self._away |= change.state == "lost" and self._stream_ns > 0
        elif self._away:
            self._away = False
            self._pipeline.restart()
        self._enter(change.state, change.reason)

    def _enter(self, state: State, reason: str | None = None) -> None:
        say = log.warning if state in ("stalled", "lost") else log.info
        say("state", state=state, was=self._state, **({"reason": reason} if reason else {}))
        self._state, self._reason = state, reason
        self._publish_health()

    def _publish_health(self) -> None:
        now_ns = self._clock()
        self._health_ns = now_ns
        event = self._health()
        self._sent = 0
        for sink in self._sinks:
            sink.publish(event, now_ns)
        self._tell_manager(event)
        # Here, and so at most once a period, however many there are.
        counts = {"lost": event.lost, "corrupt": event.corrupt, "clipped": event.clipped, **event.skipped}
        for name in ("lost", "corrupt", "clipped", "frozen", "behind", "emitter_fault", "test_pattern"):
            in_all, before = counts.get(name, 0), self._logged.get(name, 0)
            if in_all > before:
                log.warning(f"frames {name}", **{name: in_all - before, f"{name}_in_all": in_all})
                self._logged[name] = in_all

    def _tell_manager(self, health: HealthEvent) -> None:
        self._manager.status(
            f"{health.state}: {health.reason}"
            if health.reason and health.state != "streaming"
            else f"{health.state}: {health.frames} frames, {health.lost} lost, {health.corrupt} corrupt"
        )
        if health.state in _READY:
            self._manager.ready()

    def _health(self) -> HealthEvent:
        pipeline = self._pipeline
        counters = pipeline.counters
        # What the pipeline misses, a device's source can tell apart.
        tally = self._live.tally if self._live is not None else Tally(lost=counters.lost)
        dropped = {"repeated": counters.repeated, "behind": tally.behind, **tally.withheld}
        return self._messages.health(
            self._stream_ns or self._clock(),
            state=self._state,
            frames=counters.frames,
            lost=tally.lost,
            corrupt=tally.corrupt,
            skipped=counters.skipped | {why: count for why, count in dropped.items() if count},
            inferred=counters.inferred,
            latency_us=self._latency(),
            noise=pipeline.noise_counts(),
            baseline_age_s=max(0.0, (self._stream_ns - pipeline.followed_ns) * 1e-9),
            model=self._model_name,
            version=__version__,
            clipped=tally.clipped,
            late=tally.late,
            unheard={topic: count for topic, count in counters.unheard.items() if count},
            reason=self._reason or pipeline.fault or ("the screen is off" if pipeline.screen_off else None),
        )

    def _latency(self) -> Latency:
        latencies_us = self._latencies_us[: min(self._sent, _LATENCIES)]
        if not len(latencies_us):
            return Latency()
        p50, p99, highest = np.percentile(latencies_us, (50, 99, 100)).round(1).tolist()
        return Latency(p50, p99, highest)


def stop_on_signals(service: Service) -> None:
    """Have SIGTERM and SIGINT end the service in order; a second one ends it at once."""

    def handle(number: int, _frame: FrameType | None) -> None:
        service.stop()
        signal.signal(number, signal.SIG_DFL)

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)


def reload_on_hangup(service: Service) -> None:
    """Have SIGHUP read the configuration again; a daemon in a terminal ends with it, one under nohup ignores it."""
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN or (sys.stdin is not None and sys.stdin.isatty()):
        return
    signal.signal(signal.SIGHUP, lambda _number, _frame: service.reload())
