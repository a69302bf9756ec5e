"""Puts a source, the pipeline and sinks together. Every verb that runs frames comes through here."""

from __future__ import annotations

import faulthandler
import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import structlog

from touchd import realtime
from touchd.awake import Awake
from touchd.config import Settings
from touchd.control import Control, path_of
from touchd.errors import SourceError
from touchd.frame import Acquisition
from touchd.keypad import Layout, load_layout
from touchd.message import Messages
from touchd.model import Model, default_model_path
from touchd.notify import Notifier
from touchd.pipeline import Pipeline
from touchd.preroll import PreRoll, save_on_signal
from touchd.recorder import describe
from touchd.recording import Meta
from touchd.reload import Reloader
from touchd.service import Service, reload_on_hangup, stop_on_signals
from touchd.sources import Source

if TYPE_CHECKING:
    from touchd.sinks import Sink
    from touchd.sinks.zeromq import ZeromqSink

PAPER = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
"""What the source paper's rig samples: the geometry of a rig that no model is there for."""

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class SourceChoice:
    """Which source the command line asked for: the DAQ on USB unless it names another."""

    replay: Path | None = None
    simulate: str | None = None
    speed: float = 1.0
    """Relative to the recording; infinite is as fast as frames are taken."""
    loop: bool = False
    seed: int = 0
    ni: bool = False


def open_source(choice: SourceChoice, settings: Settings, model: Model | None = None) -> Source:
    """Return the source that was asked for; each backend is imported on use.

    Parameters
    ----------
    choice : SourceChoice
    settings : Settings
        Those of `device` and `ni`, the DAQ to use if no other source was named.
    model : Model, optional
        What the DAQ's frames are for: it may then be plugged in later, and one that the model does not fit is refused.
        Without a model the DAQ has to be there.

    Raises
    ------
    SourceError
        If several were named, or a scene shall run at a speed of its own; or the DAQ cannot be used.
    """
    asked = {"--replay": choice.replay is not None, "--simulate": choice.simulate is not None, "--ni": choice.ni}
    named = [option for option, given in asked.items() if given]
    if len(named) > 1:
        raise SourceError("several sources were named", " and ".join(named), "name one of them")
    if choice.replay is not None:
        from touchd.sources.replay import ReplaySource

        return ReplaySource(choice.replay, speed=choice.speed, loop=choice.loop)
    if choice.simulate is not None:
        from touchd.sources.simulated import SimulatedSource

        if choice.speed not in (1.0, float("inf")):
            raise SourceError(
                "a live scene has no other speed", f"--speed {choice.speed:g}", "leave it out, or say max"
            )
        return SimulatedSource(
            choice.simulate, seed=choice.seed, paced=choice.speed != float("inf"), loop=choice.loop
        )  # fmt: skip
    if choice.ni:
        from touchd.sources.live import DaqSource
        from touchd.sources.ni import NiDaq

        acquisition = model.description.acquisition if model else PAPER
        check = model.check if model else (lambda _acquisition: None)
        return DaqSource(lambda: NiDaq(settings.ni, acquisition), settings.device, acquisition, check)
    from touchd.sources.usb import open_usb

    if model is None:
        return open_usb(settings.device)
    return open_usb(settings.device, model.description.acquisition, model.check)


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
