"""Composes the daemon: opens the source, the bus and the pre-roll, builds the service, and closes all at the end."""

from __future__ import annotations

import faulthandler
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import dataclass
from functools import partial

import structlog

from touchd.config.schema import Settings
from touchd.detection.detector import OTHER_CHIRP
from touchd.errors import SourceError
from touchd.files import is_missing
from touchd.keypad import Layout
from touchd.localization.model import Model, default_model_path
from touchd.pipeline import Pipeline
from touchd.recording.data import Meta
from touchd.service import realtime
from touchd.service.control import Control, path_of
from touchd.service.frame_feed import FeedDescription, FrameFeed, rate_of
from touchd.service.loop import Service
from touchd.service.models import layout_of, settings_for
from touchd.service.models import load_model as load_model
from touchd.service.preroll import PreRoll
from touchd.service.signals import deliver, reload_on_hangup, save_on_signal, stop_on_signals
from touchd.service.systemd import Notifier
from touchd.sinks.sink import JsonlSink, Sink
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.open import SourceChoice, open_source
from touchd.sources.recorder import describe_source
from touchd.sources.source import Source

Step = Callable[[str], AbstractContextManager[object]]

log = structlog.get_logger()


def log_notice(reason: str, fields: dict[str, float]) -> None:
    """Log why the baseline is relearned, or that another pane's chirp was found."""
    if reason == OTHER_CHIRP:
        fix = "keep their cables apart, or let both share one clock"
        log.warning("another pane's chirp, on a clock of its own, is subtracted from frames", fix=fix, **fields)
    else:
        log.info("baseline relearned", reason=reason, **fields)


def find_model(settings: Settings) -> Model | None:
    """Return the model in use; None if the settings name one that is not there yet: the daemon is uncalibrated."""
    path = settings.model.path
    return None if path is not None and is_missing(path) else load_model(settings)


@dataclass(slots=True)
class Parts:
    """What a daemon opens before its source. A part that was refused, or is not wanted or not there yet, is None."""

    bus: ZeromqSink | None = None
    control: Control | None = None
    model: Model | None = None
    layout: Layout | None = None


def open_parts(settings: Settings, stack: ExitStack, step: Step = nullcontext) -> Parts:
    """Open what needs no plate: what is refused soonest first. `touchd doctor` opens the same.

    `step` returns the context in which the part of that name is opened: if it suppresses a part's TouchdError, the
    others are opened nevertheless.
    """
    parts = Parts()
    with step("bus"):
        parts.bus = stack.enter_context(closing(ZeromqSink(settings.bus)))
    with step("control"):
        if (where := path_of(settings.control)) is not None:
            parts.control = stack.enter_context(closing(Control(where, settings.control.group)))
    with step("model"):
        parts.model = find_model(settings)
    if parts.model is not None:
        with step("keypad"):
            parts.layout = layout_of(settings, parts.model)
    return parts


def make_pipeline(
    source: Source,
    settings: Settings,
    model: Model | None = None,
    notify: Callable[[str, dict[str, float]], None] = log_notice,
) -> Pipeline:
    """Return the pipeline for a source, with the model that the settings name unless one is given."""
    model = model or load_model(settings)
    return Pipeline(source.acquisition, model, settings, layout_of(settings, model), notify)


def feed_description(source: Source, settings: Settings, choice: SourceChoice, pipeline: Pipeline) -> FeedDescription:
    """Describe a source's frames, as they are now, to those who record them."""
    known, model = source.meta, pipeline.model
    plate = model.description.plate if model else None
    return FeedDescription(
        acquisition=source.acquisition, rate_hz=rate_of(source, settings.device),
        source=known.source if known else choice.kind, plate=known.plate if known else plate,
        device=source.device, emitter_mm=known.emitter_mm if known else None,
        receivers_mm=(known.receivers_mm if known else None) or (),
        keypad=pipeline.layout is not None or (model is None and settings.keypad.layout is not None),
    )  # fmt: skip


def recording_meta(source: Source, d: FeedDescription) -> Meta:
    """Return the description of a recording of a source that begins now; SourceError if its plate is unknown."""
    if d.plate is None:
        raise SourceError("no plate is known without a model", "pre-roll", "touchd calibrate")
    return describe_source(source, d.plate, d.rate_hz, d.source)


def warn_of_another_plate(source: Source, model: Model | None) -> None:
    """Log if a recording or a scene is of a plate of another size than the model's."""
    known = source.meta
    if not (known and model):
        return
    sizes = [f"{p.width_mm:.0f} x {p.height_mm:.0f} mm" for p in (known.plate, model.description.plate)]
    if sizes[0] != sizes[1]:
        shipped = "" if model.path == default_model_path() else f"; the shipped one is {default_model_path()}"
        log.warning("the frames are of another plate than the model", frames=sizes[0], model=sizes[1],
                    path=str(model.path), fix=f"--model FILE{shipped}")  # fmt: skip


def run(
    settings: Settings,
    choice: SourceChoice,
    *,
    echo: bool = False,
    await_subscriber_s: float = 0.0,
    read_settings: Callable[[], Settings] | None = None,
) -> None:
    """Run the daemon until its source ends or a signal comes.

    With `echo` each event is also printed as a line of JSON. The first frame is held back until somebody subscribes to
    `touch`, for at most `await_subscriber_s` (BusTimeout). `read_settings` reads the configuration again on SIGHUP.
    """
    settings = settings_for(settings, choice)
    reread = None if read_settings is None else lambda: settings_for(read_settings(), choice)
    realtime.raise_file_limit()
    with ExitStack() as stack:
        manager = stack.enter_context(closing(Notifier.from_environment()))
        if manager.watchdog_s:
            # The manager kills a daemon that hangs by SIGABRT: the log then has a traceback, of function names alone.
            faulthandler.enable()
        parts = open_parts(settings, stack)
        bus, model = parts.bus, parts.model
        assert bus is not None
        if model is None:
            log.warning("there is no model", path=str(settings.model.path), fix="touchd calibrate makes one")
        # Last: the twin computes its plate for many seconds.
        source = stack.enter_context(closing(open_source(choice, settings, model, late=True)))
        warn_of_another_plate(source, model)
        sinks: list[Sink] = [bus, JsonlSink(sys.stdout)] if echo else [bus]

        pipeline = Pipeline(source.acquisition, model, settings, parts.layout, log_notice)
        description = partial(feed_description, source, settings, choice, pipeline)
        preroll = PreRoll(description().rate_hz, lambda: recording_meta(source, description()), settings.preroll)
        stack.callback(preroll.close)
        service = Service(
            source, sinks, settings, pipeline, manager=manager, preroll=preroll, control=parts.control,
            read_settings=reread, feed=FrameFeed(description),
        )  # fmt: skip
        stop_on_signals(service)
        if read_settings is not None:
            reload_on_hangup(service)
        save_on_signal(preroll)
        deliver()
        realtime.freeze()
        if await_subscriber_s:
            bus.wait_for_subscriber(await_subscriber_s, stopped=lambda: service.stopped)
        service.run()
