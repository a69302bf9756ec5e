"""`touchd train`: train a model on a labelled recording."""

from __future__ import annotations

import json
import math
from pathlib import Path

import click

from touchd.cli.options import PATH, check_model_output
from touchd.files import check_output
from touchd.localization.atlas import atlas_path
from touchd.training.network.recipe import RECIPES

_RECIPES = "\n".join(["\b", "Recipes:", *(f"  {recipe.name:16}  {recipe.what}" for recipe in RECIPES.values())])

MOST_ZONES, MOST_SEED = 1000, (1 << 63) - 1
"""Of what a model can describe, and PyTorch can take."""


@click.command(epilog=_RECIPES)
@click.argument("recording", type=PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=PATH, required=True, help="The model to write (ONNX).")
@click.option(
    "--recipe", type=click.Choice(list(RECIPES)), default="best", show_default=True, metavar="NAME",
    help="Recipe to train by, from the list below.",
)  # fmt: skip
@click.option("--n", "grid", default=10, type=click.IntRange(max=MOST_ZONES), show_default=True,
              help="Zones along each side, for the grid recipes.")  # fmt: skip
@click.option("--layout", type=PATH, help="Keys (TOML), for the keypad recipes.  [default: 3 x 4]")
@click.option("--network", type=PATH, help="Recipe atlas: use this network, trained on RECORDING.")
@click.option("--seed", default=0, type=click.IntRange(0, MOST_SEED), show_default=True,
              help="Seed of the split, the weights and the augmentation.")  # fmt: skip
@click.option("--epochs", type=click.IntRange(min=1), help="Passes over the touches.  [default: the recipe's]")
@click.option("--lines", "as_lines", is_flag=True, help="Print one JSON object a line: progress, then the result.")
@click.option("--no-report", is_flag=True, help="Write no report.")
@click.option("--force", is_flag=True, help="Replace what exists.")
def command(
    recording: tuple[Path, ...],
    output: Path,
    recipe: str,
    grid: int,
    layout: Path | None,
    network: Path | None,
    seed: int,
    epochs: int | None,
    as_lines: bool,
    no_report: bool,
    force: bool,
) -> None:
    """Train a model on RECORDING, a labelled recording of single touches.

    Several recordings of one plate and one acquisition train one model. Warnings, such as a dead channel or too few
    touches, appear first. 70 % of the touches train, 20 % validate, 10 % test; the test scores are printed and stored
    in the model. Beside it lies a folder named .report, and with the recipe atlas the field atlas, .atlas.npz, which
    learns from the validating touches too once they have calibrated it.
    """
    from touchd.recording.format import read
    from touchd.training.data.join import join

    chosen = RECIPES[recipe]
    if network and not chosen.atlas:
        raise click.UsageError("--network is for the recipe atlas")
    _check_free(output, network, force=force)
    epochs = epochs or chosen.epochs
    options = f" --n {grid}" * (chosen.head == "grid")
    options += f" --layout {layout.name}" if layout and chosen.head == "keypad" else ""
    options += f" --network {network.name}" if network else f" --seed {seed} --epochs {epochs}"
    names = [path.name for path in recording]
    said = f"touchd train {' '.join(names)} -o {output.name} --recipe {recipe}{options}"
    touches = join([read(path) for path in recording], [str(path) for path in recording])
    # Only now, as PyTorch takes seconds: what is wrong with the recordings is said at once.
    from touchd.cli.progress import Bars
    from touchd.keypad import PHONE, load_layout
    from touchd.training.report.report import PAGE, remove_report, write_atlas_report, write_report
    from touchd.training.train_atlas import train_atlas
    from touchd.training.train_network import train

    bars = Bars()

    def progress(what: str, done: int, steps: int, rmse_mm: float) -> None:
        note = "" if math.isnan(rmse_mm) else f"validation {rmse_mm:.2f} mm"
        if as_lines:
            click.echo(json.dumps({"stage": what, "share": round(done / steps, 3), "note": note}))
        else:
            bars.update(what, done, steps, note)

    with bars:
        if chosen.atlas:
            made = train_atlas(
                touches, output, network, seed=seed, epochs=epochs, command=said, progress=progress, warn=bars.warn
            )
            result, scores, path = made.network, made.scores, made.path
        else:
            made = None
            result = train(
                touches,
                output,
                chosen,
                grid=grid,
                layout=load_layout(layout or PHONE, touches.meta.plate) if chosen.head == "keypad" else None,
                seed=seed,
                epochs=epochs,
                command=said,
                progress=progress,
                warn=bars.warn,
            )
            scores, path = result.scores, output
            atlas_path(output).unlink(missing_ok=True)  # the replaced model's atlas
    if as_lines:
        click.echo(json.dumps({"model": str(path), "scores": scores}))
    else:
        click.echo(f"{path}: on {scores['n']:.0f} touches never seen in training:")
        for name, value in scores.items():
            if name != "n":
                click.echo(f"  {name:17} {value:8.3f}")
    for each in (output, atlas_path(output)):
        if no_report or not (made or each == output):
            remove_report(each)  # the replaced model's report
    if no_report:
        return
    if result:
        folder = write_report(result, touches.meta, names)
        click.echo(f"{folder / PAGE}: scores, learning curve and plots", err=as_lines)
    if made:
        folder = write_atlas_report(made, touches.meta, names)
        click.echo(f"{folder / PAGE}: the atlas' scores, maps and plots", err=as_lines)


def _check_free(output: Path, network: Path | None, *, force: bool) -> None:
    """Raise OutputError if the model or its atlas exists, or cannot be written.

    An atlas beside another model would be used with it, so it counts as existing output.
    """
    check_model_output(output)
    for file in (output, atlas_path(output)):
        given = network is not None and file.exists() and file.samefile(network)
        check_output(file, replace=force or given)
