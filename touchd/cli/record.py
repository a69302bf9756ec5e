"""`touchd record`: write the frames of any source to a file; with --label, tell a person what to do meanwhile."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Event
from typing import Any

import click

from touchd.calibration.walk import Walk, plan
from touchd.cli.options import PATH, NumberRange, chosen, config_option, plate_of, source_options
from touchd.cli.output import say
from touchd.config.load import load
from touchd.errors import ConfigError, OutputError, SourceError
from touchd.frame import Frame, Plate
from touchd.recording.data import Device, Meta, Recording
from touchd.service.frame_feed import DaemonSource, open_running, rate_of
from touchd.service.runner import frames_of
from touchd.service.signals import stopping
from touchd.sources.open import open_source
from touchd.sources.recorder import MAX_FILE_FRAMES, GrowingFile, Recorder, describe_source, prepare
from touchd.sources.source import Change, Source

_TIMEOUT_S = 0.2
"""A signal takes effect within this time while no frame arrives."""
REPEAT = "r"
BY_HAND = (
    "PLATE.toml, and how you measured",
    "the pane: kind of glass or metal, laminated or not, what holds its edges",
    "the discs: maker, diameter, thickness; the glue; cables and series resistor",
    "the device: name, gain setting, sample rate; the room's temperature",
    "photographs of pane, discs and cables; who touched: dry or damp fingers, child or adult",
)


def _plate(_ctx: click.Context, _param: click.Parameter, value: str | None) -> Plate | None:
    """Parse `400x300` or `400x300x5` into a plate."""
    said = "write WIDTHxHEIGHT or WIDTHxHEIGHTxTHICKNESS in mm, for example 400x300x5"
    return None if value is None else plate_of(value, said)


def _notes(_ctx: click.Context, _param: click.Parameter, value: str) -> str:
    """Refuse text that no file can hold."""
    if any("\ud800" <= character <= "\udfff" for character in value):
        raise click.BadParameter("is not UTF-8")
    return value


@click.command()
@click.option("-o", "--output", type=PATH, required=True,
              help="Output: one file if it ends in .npz, else a folder of chunks.")  # fmt: skip
@source_options
@click.option("--frames", type=click.IntRange(1), metavar="N", help="Stop after N frames.")
@click.option("--seconds", type=NumberRange(0, min_open=True), metavar="S", help="Stop after S seconds.")
@click.option("--chunk-frames", type=click.IntRange(1, 1_000_000), default=5000, show_default=True, metavar="N",
              help="Frames per chunk of a folder; a power cut loses at most one chunk.")  # fmt: skip
@click.option("--plate", callback=_plate, metavar="WxH[xT]", help="Size of the plate in mm, if the source has none.")
@click.option("--label", is_flag=True, help="Ask for touches, one after the other, and label them; -o ends in .npz.")
@click.option("--notes", default="", callback=_notes, help="Text to store in the recording.")
@config_option
def command(
    output: Path,
    frames: int | None,
    seconds: float | None,
    chunk_frames: int,
    plate: Plate | None,
    label: bool,
    notes: str,
    config: Path | None,
    **named: Any,
) -> None:
    """Write the frames of the DAQ, or of another source, to a file.

    While a daemon with a control socket runs, as the service, its frames are recorded: run this as its own user, or
    as root.
    A recording can reveal a PIN: it is readable by you only. Ctrl-C, SIGTERM and SIGHUP save the frames so far.
    Without --label it stores no true contacts.

    With --label it asks for ten minutes of touches at places that it names: what a report of a real plate needs, and
    what `touchd calibrate`, `calibrate --taps` and `check` take. Each touch is in the file soon after it is complete.
    """
    if output.suffix == ".npz" and frames is not None and frames > MAX_FILE_FRAMES:
        raise ConfigError(
            f"one file holds at most {MAX_FILE_FRAMES} frames", "--frames",
            "record into a folder: give -o a name that does not end in .npz",
        )  # fmt: skip
    if label and (output.suffix != ".npz" or frames is not None or seconds is not None):
        raise click.UsageError("--label writes one file, -o NAME.npz, and ends with its last touch or with Ctrl-C")
    choice = chosen(named)
    settings = load(config)
    source = open_running(choice, settings) or open_source(choice, settings)
    with ExitStack() as stack:
        # To the end: a terminal that goes sends SIGHUP more than once.
        stop = stack.enter_context(stopping())
        stack.callback(source.close)
        meta = _meta(source, plate, rate_of(source, settings.device), choice.kind, notes)
        if label:
            walk_through(source, output, meta)
            return
        recorder = Recorder(output, meta, chunk_frames=chunk_frames)
        say(f"recording to {output}: it can reveal a PIN, and only you can read it")
        try:
            with closing(source):  # the device is free while the file is written
                _record(source, recorder, frames, seconds, stop)
        finally:  # save the frames that arrived before a failure, too
            try:
                recorder.close()
            finally:
                _report(recorder)
    if not recorder.frames:
        raise SourceError("no frame came, nothing is saved", fix="check that the source runs")
    _refuse_other(output, recorder.path)


def _report(recorder: Recorder) -> None:
    if recorder.frames:
        of = f" of {recorder.frames}" if recorder.saved < recorder.frames else ""
        dropped = f", {recorder.dropped} out of order and not kept" if recorder.dropped else ""
        say(f"{recorder.path}: {recorder.saved}{of} frames saved, {recorder.lost} lost on their way here{dropped}")


def _refuse_other(output: Path, saved: Path) -> None:
    """Raise OutputError if the frames are saved under another name than the one asked for."""
    if saved != output:
        raise OutputError("exists already, made while this recorded", str(output), f"the frames are in {saved}")


def _record(source: Source, recorder: Recorder, frames: int | None, seconds: float | None, stop: Event) -> None:
    """Record frames until the end, a limit or a signal."""
    first_ns = None
    # At 125 frames/s the last frame of a second begins 8 ms before its end; another half period allows for jitter.
    last_s = (seconds or 0) - 1.5 / recorder.meta.frame_rate_hz
    started_s = time.monotonic()
    for frame in until(stop, source):
        if frame is None:
            # A silent source must not extend a recording of ten seconds.
            if seconds is not None and time.monotonic() - started_s >= seconds:
                break
            continue
        recorder.keep(frame)
        first_ns = frame.t_ns if first_ns is None else first_ns
        if recorder.frames == frames:
            break
        if seconds is not None and frame.t_ns - first_ns >= last_s * 1e9:
            break


def _meta(source: Source, plate: Plate | None, rate_hz: float, kind: str, notes: str) -> Meta:
    """Return the recording's metadata; ConfigError if neither the source nor the command line tells the plate."""
    known = source.description if isinstance(source, DaemonSource) else getattr(source, "meta", None)
    if known is not None:
        plate, kind = plate or known.plate, known.source or kind
    if plate is None:
        raise ConfigError("the plate's size is not known", "--plate", "add --plate WIDTHxHEIGHT, in mm")
    return describe_source(source, plate, rate_hz, kind, notes)


def until(stop: Event, source: Source, on_return: Callable[[], object] = lambda: None) -> Iterator[Frame | None]:
    """Yield a source's frames until a signal; report what becomes of the device, call `on_return` if it was away."""
    away = False

    def report(change: Change) -> None:
        nonlocal away
        say(f"device {change.state}: {change.reason}".removesuffix(": "), err=True)
        if change.state == "lost":
            away = True
        elif change.state == "streaming" and away:
            away = False
            on_return()

    for frame in frames_of(source, _TIMEOUT_S, on_change=report):
        yield frame
        if stop.is_set():
            return


def walk_through(source: Source, output: Path, meta: Meta) -> None:
    """Walk a person through all acts, and save those that are complete, after each."""
    prepare(output, single=True)
    # The plate is told in public, the device's number need not be.
    meta = meta.model_copy(update={"device": Device(firmware=meta.device.firmware)})
    walk, file = Walk(source.acquisition, plan(meta.plate)), GrowingFile(output)
    try:
        lines = Lines(sys.stdin.fileno())
    except (OSError, ValueError, AttributeError):
        lines = Lines(None)  # no terminal, nor a file in its place
    say(f"recording to {output}: it can reveal a PIN, so type none; only you can read it")
    say(f"Enter leaves a touch out, {REPEAT} and Enter repeats the one before, Ctrl-C ends and saves")
    with stopping() as stop:
        try:
            asked, kept, problem = None, 0, ""
            for frame in until(stop, source, walk.restart):
                if asked != walk.asked:
                    asked = walk.asked
                    say(f"{walk.next + 1} of {len(walk.tasks)}: {walk.tasks[walk.next].text}")
                if walk.complete != kept and not file.busy:
                    kept = walk.complete
                    if (found := walk.recording(meta)) is not None:
                        file.begin(found)
                if file.problem not in ("", problem):
                    problem = file.problem
                    say(f"{problem}; nothing is lost yet: the end saves all", err=True)
                if frame is not None and (said := walk.feed(frame)):
                    say(said)
                if (line := lines.take()) is not None:
                    if line.casefold() not in (REPEAT, ""):
                        say(f"Enter alone leaves this touch out, {REPEAT} and Enter repeats the one before")
                        continue
                    walk.repeat() if line else walk.skip()
                if walk.next == len(walk.tasks):
                    break
        finally:  # save what is complete before a failure, too
            found = walk.recording(meta)
            if found is None:
                file.remove()
            else:
                saved = _save(file, found, lines, stop)
                say(f"{saved}: {len(found.frames)} frames of {len(found.meta.acts)} acts saved")
                say(checklist(walk))
    if found is None:
        raise SourceError("no act is complete, nothing is saved", fix="begin with ten seconds without a touch")
    _refuse_other(output, saved)


def _save(file: GrowingFile, found: Recording, lines: Lines, stop: Event) -> Path:
    """Write a file and return its path; where that fails, ask at the terminal to make room, and write it again."""
    while True:
        try:
            return file.finish(found)
        except OutputError as error:
            if not lines.open:
                raise
            stop.clear()
            say(str(error), err=True)
            say("nothing is lost yet: make room, then press Enter to save again; Ctrl-C gives it up")
            while lines.take() is None:
                if stop.wait(_TIMEOUT_S) or not lines.open:
                    raise


def checklist(walk: Walk) -> str:
    """Return what was recorded, what is missing, and what to write beside it."""
    lines = []
    for name in dict.fromkeys(task.name for task in walk.tasks):
        done, of = walk.count(name)
        lines.append(f"  [{'x' if done == of else ' '}] {name}: {done} of {of}")
    return "\n".join([*lines, "write beside it, by hand:", *(f"  [ ] {what}" for what in BY_HAND)])


class Lines:
    """Lines that a person types, without waiting for any; at the end of the file descriptor nothing more is typed."""

    def __init__(self, handle: int | None) -> None:
        self._handle = handle
        self._text = b""

    @property
    def open(self) -> bool:
        """Whether more may be typed."""
        return self._handle is not None

    def take(self) -> str | None:
        """Return the next line, stripped; None before one came."""
        if self._handle is not None and select.select([self._handle], [], [], 0)[0]:
            try:
                more = os.read(self._handle, 4096)
            except OSError:  # the terminal has gone
                more = b""
            self._text += more
            self._handle = self._handle if more else None
        line, end, rest = self._text.partition(b"\n")
        if not end:
            return None
        self._text = rest
        return line.decode(errors="replace").strip()
