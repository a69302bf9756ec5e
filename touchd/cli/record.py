"""`touchd record`: write the frames of any source to a file."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchd.cli.interrupt import stopping, until
from touchd.cli.options import chosen, config_option, source_options
from touchd.errors import ConfigError, SourceError
from touchd.frame import Plate, parse_plate

if TYPE_CHECKING:
    from touchd.recording.data import Meta
    from touchd.sources.recorder import Recorder
    from touchd.sources.source import Source


def _plate(_ctx: click.Context, _param: click.Parameter, value: str | None) -> Plate | None:
    """Parse `400x300` or `400x300x5` into a plate."""
    try:
        return None if value is None else parse_plate(value)
    except ValueError:
        raise click.BadParameter("write WIDTHxHEIGHT or WIDTHxHEIGHTxTHICKNESS in mm, for example 400x300x5") from None


@click.command()
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True,
              help="Output: one file if it ends in .npz, else a folder of chunks.")  # fmt: skip
@source_options
@click.option("--frames", type=click.IntRange(1), metavar="N", help="Stop after N frames.")
@click.option("--seconds", type=click.FloatRange(0, min_open=True), metavar="S", help="Stop after S seconds.")
@click.option("--chunk-frames", type=click.IntRange(1, 1_000_000), default=5000, show_default=True, metavar="N",
              help="Frames per chunk of a folder; a power cut loses at most one chunk.")  # fmt: skip
@click.option("--plate", callback=_plate, metavar="WxH[xT]", help="Size of the plate in mm, if the source has none.")
@click.option("--label", is_flag=True, help="Ask for touches, one after the other, and label them; -o ends in .npz.")
@click.option("--notes", default="", help="Text to store in the recording.")
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
    A recording can reveal a PIN: it is readable by you only. Ctrl-C and SIGTERM save the frames so far. It stores
    frames alone, without true contacts.

    With --label it asks for ten minutes of touches at places that it names: what a report of a real plate needs, and
    what `touchd calibrate`, `calibrate --taps` and `check` take.
    """
    from touchd.config.load import load
    from touchd.service.frame_feed import open_running, rate_of
    from touchd.sources.open import open_source
    from touchd.sources.recorder import MAX_FILE_FRAMES, Recorder

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
        stack.callback(source.close)
        meta = _meta(source, plate, rate_of(source, settings.device), choice.kind, notes)
        if label:
            from touchd.cli.label import walk_through

            walk_through(source, output, meta)
            return
        recorder = Recorder(source, output, meta, chunk_frames=chunk_frames)
        click.echo(f"recording to {output}: it can reveal a PIN, and only you can read it")
        try:
            _record(recorder, frames, seconds)
        finally:  # save the frames that arrived before a failure, too
            recorder.close()
            if recorder.frames:
                dropped = f", {recorder.dropped} out of order and not kept" if recorder.dropped else ""
                click.echo(f"{output}: {recorder.frames} frames saved, {recorder.lost} lost on their way here{dropped}")
    if not recorder.frames:
        raise SourceError("no frame came, nothing is saved", fix="check that the source runs")


def _record(recorder: Recorder, frames: int | None, seconds: float | None) -> None:
    """Read frames through the recorder until the end, a limit or a signal."""
    first_ns = None
    # At 125 frames/s the last frame of a second begins 8 ms before its end; another half period allows for jitter.
    last_s = (seconds or 0) - 1.5 / recorder.meta.frame_rate_hz
    started_s = time.monotonic()
    with stopping() as stop:
        for frame in until(stop, recorder):
            if recorder.frames == frames:
                break
            if frame is None:
                # A silent source must not extend a recording of ten seconds.
                if seconds is not None and time.monotonic() - started_s >= seconds:
                    break
                continue
            first_ns = frame.t_ns if first_ns is None else first_ns
            if seconds is not None and frame.t_ns - first_ns >= last_s * 1e9:
                break


def _meta(source: Source, plate: Plate | None, rate_hz: float, kind: str, notes: str) -> Meta:
    """Return the recording's metadata: the source's own, if it has any."""
    from touchd.recording.data import Meta
    from touchd.service.frame_feed import DaemonSource
    from touchd.sources.recorder import describe

    known = getattr(source, "meta", None)
    if isinstance(source, DaemonSource):
        plate, kind = plate or source.description.plate, source.description.source
    if isinstance(known, Meta):
        plate, kind = plate or known.plate, known.source or kind
    if plate is None:
        raise ConfigError("the plate's size is not known", "--plate", "add --plate WIDTHxHEIGHT, in mm")
    device = getattr(source, "device", None)
    fresh = describe(source.acquisition, plate, rate_hz, source=kind, device=device, notes=notes)
    if not isinstance(known, Meta):
        return fresh
    changes = {"plate": fresh.plate, "source": fresh.source, "created": fresh.created, "notes": notes or known.notes,
               "acts": ()}  # fmt: skip
    return known.model_copy(update=changes)
