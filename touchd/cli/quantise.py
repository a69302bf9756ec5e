"""`touchd quantise`: quantise a model's weights to 8 bits."""

from __future__ import annotations

from pathlib import Path

import click

from touchd.cli.options import PATH, check_model_output


@click.command()
@click.argument("model", type=PATH)
@click.argument("recording", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="The model to write (ONNX).")
@click.option("--force", is_flag=True, help="Replace the output if it exists.")
def command(model: Path, recording: Path, output: Path, force: bool) -> None:
    """Quantise the weights of MODEL to 8 bits, a quarter of the size.

    RECORDING is the one that MODEL was trained on; its test touches measure the loss of accuracy.
    """
    from touchd.localization.model import Model
    from touchd.recording.format import read
    from touchd.training.network.export import quantise

    check_model_output(output, replace=force)
    original = Model(model)
    made = quantise(original, read(recording), output)
    click.echo(f"{output}: {output.stat().st_size / 1e3:.0f} kB, {model.stat().st_size / 1e3:.0f} kB before")
    before, after = original.description.scores, made.description.scores
    for name in after:
        if name != "n" and name in before:
            click.echo(f"  {name:17} {before[name]:8.3f} -> {after[name]:8.3f}")
