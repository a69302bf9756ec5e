"""`touchd train`: a model from a labelled recording."""

from __future__ import annotations

import math
from pathlib import Path

import click

from touchd.errors import OutputError


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The model to write (ONNX).")
@click.option("--seed", default=0, show_default=True, help="Seed of the split, the weights and the augmentation.")
@click.option("--epochs", default=300, show_default=True, type=click.IntRange(min=1), help="Passes over the touches.")
@click.option("--force", is_flag=True, help="Replace the model if it exists.")
def command(recording: Path, output: Path, seed: int, epochs: int, force: bool) -> None:
    """Train a model on RECORDING, a labelled recording of single touches.

    The touches are split at random into 70 % for training, 20 % for validation and 10 % for the test; the scores
    printed at the end, and stored in the model, are those of the test.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from touchd.recording import read
    from touchd.training.train import train_regression

    if output.exists() and not force:
        raise OutputError("already there", str(output), "choose another name, or add --force")
    with Progress(
        TextColumn("{task.description:8}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeRemainingColumn(),
    ) as bar:
        tasks = {what: bar.add_task(what, total=None, note="") for what in ("field", "network")}

        def progress(what: str, done: int, steps: int, rmse_mm: float) -> None:
            note = "" if math.isnan(rmse_mm) else f"validation {rmse_mm:.2f} mm"
            bar.update(tasks[what], completed=done, total=steps, note=note)

        result = train_regression(
            read(recording),
            output,
            seed=seed,
            epochs=epochs,
            command=f"touchd train {recording.name} -o {output.name} --seed {seed} --epochs {epochs}",
            progress=progress,
        )
    click.echo(f"{output}: on {result.scores['n']:.0f} touches never seen in training:")
    for name, value in result.scores.items():
        if name != "n":
            click.echo(f"  {name:13} {value:8.3f}")
