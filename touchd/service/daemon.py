"""Puts a source, the pipeline and sinks together. Every verb that runs frames comes through here."""

from __future__ import annotations

import faulthandler
import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING

import structlog

from touchd.config.schema import Settings
from touchd.keypad import Layout, load_layout
from touchd.localization.model import Model, default_model_path
from touchd.pipeline import Pipeline
from touchd.recording.data import Meta
from touchd.service import realtime
from touchd.service.control import Control, path_of
from touchd.service.cpu_latency import Awake
from touchd.service.loop import Service, reload_on_hangup, stop_on_signals
from touchd.service.preroll import PreRoll, save_on_signal
from touchd.service.reload import Reloader
from touchd.service.systemd import Notifier
from touchd.sinks.messages import Messages
from touchd.sources.open import SourceChoice, open_source
from touchd.sources.recorder import describe
from touchd.sources.source import Source

if TYPE_CHECKING:
    from touchd.sinks.sink import Sink
    from touchd.sinks.zeromq import ZeromqSink

log = structlog.get_logger()


def log_notice(reason: str, fields: dict[str, float]) -> None:
    """Log that the baseline is learned anew."""
    log.info("baseline learned anew", reason=reason, **fields)


def make_pipeline(
    source: Source,
    settings: Settings,
    messages: Messages,
    sinks: Sequence[Sink] = (),
    notify: Callable[[str, dict[str, float]], None] = log_notice,
    model: Model | None = None,
) -> tuple[Pipeline, Model]:
    """Return the pipeline for a source, with the model that the settings name unless it is loaded already.

    Without sinks the caller is taken for one, who wants all events but the spectra.
    """
    model = model or load_model(settings)
    layout = layout_of(settings, model)

    def wanted(topic: str) -> bool:
        return any(sink.wants(topic) for sink in sinks) if sinks else topic != "spectrum"

    wants = sinks[0].wants if len(sinks) == 1 else wanted  # it is asked with every touched frame
    pipeline = Pipeline(source.acquisition, model, settings, messages, layout, wants, notify)
    return pipeline, model


def load_model(settings: Settings) -> Model:
    """Return the model that the settings name."""
    return Model(settings.model.path or default_model_path(), atlas=settings.model.atlas)


def layout_of(settings: Settings, model: Model) -> Layout | None:
    """Return the keys, in keypad mode: those that the settings name, or else the model's own."""
    return load_layout(settings.keypad.layout) if settings.keypad.layout else model.description.layout


def make_preroll(source: Source, settings: Settings, model: Model, choice: SourceChoice) -> PreRoll | None:
    """Return what keeps the last seconds of a source's frames, if the settings ask for any."""
    if not settings.preroll.seconds:
        return None
    known = getattr(source, "meta", None)
    kind = "simulated" if choice.simulate else "replay" if choice.replay else "ni" if choice.ni else "usb"
    rate_hz = known.frame_rate_hz if known else float(settings.device.rate_hz)

    def meta() -> Meta:
        device = getattr(source, "device", None)
        fresh = describe(source.acquisition, model.description.plate, rate_hz, source=kind, device=device)
        return known.model_copy(update={"created": fresh.created}) if known else fresh

    return PreRoll(source.acquisition, rate_hz, meta, settings.preroll)


def make_messages(settings: Settings) -> Messages:
    """Return the maker of this device's messages."""
    return Messages(settings.device.name, time.time_ns() - time.monotonic_ns())


def run(
    settings: Settings,
    choice: SourceChoice,
    *,
    echo: bool = False,
    await_subscriber_s: float = 0.0,
    read_settings: Callable[[], Settings] | None = None,
) -> None:
    """Run the daemon until its source ends or a signal comes.

    Parameters
    ----------
    echo : bool
        Also print each event as a line of JSON on standard output.
    await_subscriber_s : float
        Hold the first frame back until somebody subscribes to `touch`, for at most so long (BusTimeout).
    read_settings : callable, optional
        Reads the configuration again on SIGHUP.
    """
    from touchd.sinks.jsonl import JsonlSink
    from touchd.sinks.zeromq import ZeromqSink

    manager = Notifier.from_environment()
    if manager.watchdog_s:
        # The manager ends what hangs by SIGABRT: the log then tells where it hung, by names of functions alone.
        faulthandler.enable()
    realtime.apply(settings.realtime)
    model = load_model(settings)
    source = open_source(choice, settings, model)
    bus: ZeromqSink | None = None
    preroll: PreRoll | None = None
    control: Control | None = None
    try:
        with realtime.giving_way() if choice.speed == math.inf else nullcontext():
            bus = ZeromqSink(settings.bus)
        sinks: list[Sink] = [bus]
        if echo:
            sinks.append(JsonlSink(sys.stdout))
        messages = make_messages(settings)
        pipeline, _ = make_pipeline(source, settings, messages, sinks, model=model)
        service = Service(
            source, pipeline, sinks, messages, settings.health, model.description.name, manager=manager,
            awake=Awake(settings.realtime.awake_from_hz),
        )  # fmt: skip
        preroll = make_preroll(source, settings, model, choice)
        if preroll is not None:
            service.keep(preroll)
            save_on_signal(preroll)
        where = path_of(settings.control)
        if where is not None:
            control = Control(where, settings.control.group)
            service.obey(control)
        stop_on_signals(service)
        if read_settings is not None:
            reloader = Reloader(settings, read_settings, lambda new: layout_of(new, model), pipeline)
            service.on_reload(reloader.reload)
            reload_on_hangup(service)
        realtime.freeze(settings.realtime)
        if await_subscriber_s:
            bus.wait_for_subscriber(await_subscriber_s, stopped=lambda: service.stopped)
        service.run()
    finally:
        source.close()
        if bus is not None:
            bus.close()
        if control is not None:
            control.close()
        if preroll is not None:
            preroll.close()
        manager.close()
