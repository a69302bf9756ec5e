"""What a verb checks before its work, which may take minutes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from touchd.errors import OutputError
from touchd.files import writing

if TYPE_CHECKING:
    from touchd.localization.model import Description
    from touchd.recording.data import Meta


def check_output(output: Path, *, replace: bool = True) -> None:
    """Raise OutputError if a file cannot be written, or exists and must not be replaced."""
    with writing(output):
        if output.exists() and not replace:
            raise OutputError("already there", str(output), "choose another name, or add --force")
        if output.is_dir():
            raise OutputError("is a folder", str(output), "name a file")
        if not os.access(output.parent, os.W_OK | os.X_OK):
            raise OutputError("not a writable folder", str(output.parent), "create it, or choose another name")


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


def warn_of_other_plate(model: Description, recording: Meta) -> None:
    """Warn if a recording is of another plate than the model's."""
    if model.plate != recording.plate:
        click.echo(
            f"touchd: warning: the model is for the plate {model.plate}, the recording is of the plate "
            f"{recording.plate}", err=True,
        )  # fmt: skip
