"""`touchd quantise`: a model with weights of 8 bits."""

from __future__ import annotations

from pathlib import Path

import click

from touchd.errors import OutputError


@click.command()
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The model to write (ONNX).")
@click.option("--force", is_flag=True, help="Replace the output if it exists.")
def command(model: Path, recording: Path, output: Path, force: bool) -> None:
    """Write MODEL with weights of 8 bits: a quarter of the size.

    RECORDING is what MODEL was trained on: its test part tells what the rounding costs.
    """
    from touchd.localization.model import Model
    from touchd.recording.format import read
    from touchd.training.network.quantise import quantise

    if output.exists() and not force:
        raise OutputError("already there", str(output), "choose another name, or add --force")
    original = Model(model)
    made = quantise(original, read(recording), output)
    click.echo(f"{output}: {output.stat().st_size / 1e3:.0f} kB, of {model.stat().st_size / 1e3:.0f} kB before")
    before, after = original.description.scores, made.description.scores
    for name in after:
        if name != "n" and name in before:
            click.echo(f"  {name:17} {before[name]:8.3f} -> {after[name]:8.3f}")
