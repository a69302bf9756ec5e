"""Options that several commands have, and what a verb checks before its work, which may take minutes."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from touchd.errors import OutputError
from touchd.files import check_output

if TYPE_CHECKING:
    from touchd.frame import Plate
    from touchd.localization.model import Description
    from touchd.recording.data import Meta
    from touchd.sources.open import SourceChoice

PATH = click.Path(path_type=Path, readable=False)
"""Whoever opens the file says why it cannot be read, and what to do."""
Command = TypeVar("Command", bound=Callable[..., Any])


class Number(click.types.FloatParamType):
    """A number; neither nan, which no range of click's refuses, nor inf."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Convert an option's text."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


class NumberRange(Number, click.FloatRange):
    """A number within bounds."""


def _or_above(ctx: click.Context, _param: click.Parameter, value: Path | None) -> Path | None:
    """Return the file that stands behind the verb, else the one before it: `touchd --config FILE VERB`."""
    return value or (ctx.obj or {}).get("config")


config_option = click.option("--config", type=PATH, callback=_or_above, help="Configuration file (TOML).")
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
bus_option = click.option(
    "--bus", "address", metavar="ADDRESS",
    help="Where the daemon publishes.  [default: the installed service, or else a touchd on this computer]",
)  # fmt: skip


def plate_of(text: str, said: str, lengths: int = 2) -> Plate:
    """Return the plate of an option's text, of `lengths` or more; raise BadParameter, `said` if they cannot be read."""
    from touchd.frame import impossible_lengths, parse_plate

    try:
        if text.lower().count("x") < lengths - 1:
            raise ValueError
        plate = parse_plate(text)
    except ValueError:
        raise click.BadParameter(said) from None
    for _key, what in impossible_lengths(*plate.size_mm, plate.thickness_mm):
        raise click.BadParameter(f"{what}; write every length in millimetres")
    return plate


def parse_speed(_ctx: click.Context, _param: click.Parameter, value: str) -> float:
    """Convert a speed option to a number; `max` is infinite."""
    if value == "max":
        return float("inf")
    try:
        speed = float(value)
    except ValueError:
        speed = 0.0
    if not 0 < speed < float("inf"):
        raise click.BadParameter("a number above 0, or max")
    return speed


SOURCE_OPTIONS = (
    click.option("--replay", type=PATH, help="Replay a recording: a file or a folder."),
    click.option("--simulate", metavar="SCENE", help="Simulate a scene of the digital twin, live."),
    click.option("--ni", is_flag=True, help="Read NI hardware: see [ni] in the configuration."),
    click.option("--audio", metavar="DEVICE", help="Read an audio interface: an ALSA name, see [audio]."),
    click.option(
        "--speed",
        default="1",
        callback=parse_speed,
        metavar="N|max",
        help="Speed of a replay; below 1 its touches seem stale, and many programs drop them.  [default: 1]",
    ),
    click.option("--loop", is_flag=True, help="Repeat a recording or scene."),
    click.option("--seed", default=0, type=click.IntRange(min=0), help="Seed of a simulated scene.", show_default=True),
)


def source_options(command: Command) -> Command:
    """Add the fields of `touchd.sources.open.SourceChoice` to a command, as options of their names."""
    for add in reversed(SOURCE_OPTIONS):
        command = add(command)
    return command


def chosen(options: dict[str, Any]) -> SourceChoice:
    """Return the source that the options name; raise UsageError if one of them has no effect on it."""
    from touchd.sources.open import SourceChoice

    choice = SourceChoice(**options)
    if choice.is_device and (choice.speed != 1 or choice.loop or choice.seed):
        raise click.UsageError("--speed, --loop and --seed apply to a recording or scene: --replay, --simulate")
    if choice.replay is not None and choice.seed:
        raise click.UsageError("--seed applies to a scene: --simulate")
    return choice


def check_model_output(output: Path, *, replace: bool = True) -> None:
    """Raise OutputError if a model cannot be written, or has not the name of one."""
    if output.suffix != ".onnx":
        raise OutputError("not the name of a model", str(output), "choose a name that ends in .onnx")
    check_output(output, replace=replace)


def check_picture(output: Path) -> None:
    """Raise OutputError if a plot cannot be written, or not in the format that its name says."""
    from matplotlib.backend_bases import FigureCanvasBase  # half a second

    check_output(output)
    kind = output.suffix.removeprefix(".").lower() or "png"
    if kind not in FigureCanvasBase.filetypes:
        raise OutputError(f"{kind!r} is no format of a plot", str(output), "choose a name that ends in .png")


STREAM_HZ = 20.0
"""Frames per second from which a recording is replayed; in a slower one each frame is scored alone."""


def warn_of_single_frames(recording: Meta) -> None:
    """Warn if a recording has no stream of frames, as a training set: a replay places few of its touches."""
    if recording.frame_rate_hz < STREAM_HZ:
        click.echo(
            f"touchd: warning: {recording.frame_rate_hz:g} frames a second are no stream to replay: touchd evaluate "
            "scores each alone", err=True,
        )  # fmt: skip


_RULER = 0.01, 0.01, 0.05
"""Share by which a person may have measured width, height and thickness wrong."""


def warn_of_other_plate(model: Description, recording: Meta) -> None:
    """Warn if a recording is of another plate than the model's, whose lengths a calibration may have corrected."""
    one, other = model.plate, recording.plate
    alike = one.material == other.material and all(
        abs(length_mm - other_mm) <= share * other_mm
        for length_mm, other_mm, share in zip(
            (*one.size_mm, one.thickness_mm), (*other.size_mm, other.thickness_mm), _RULER, strict=True
        )
    )
    if not alike:
        click.echo(
            f"touchd: warning: the model is for a plate of {model.plate}, the recording is of one of "
            f"{recording.plate}", err=True,
        )  # fmt: skip
