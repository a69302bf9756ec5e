"""`touchd reproduce`: repeat the source paper's experiments."""

from __future__ import annotations

from pathlib import Path

import click

from touchd.cli.options import PATH
from touchd.errors import RecordingValues
from touchd.files import check_output


@click.command()
@click.argument("recording", type=PATH, required=False)
@click.option(
    "-o", "--output", type=PATH, default=Path("reproduction.md"), show_default=True,
    help="Report to write (Markdown); plots and tables go to a folder of the same name.",
)  # fmt: skip
@click.option("--layout", type=PATH, help="Keys of the keypad (TOML).  [default: 3 x 4]")
@click.option("--seed", default=0, type=click.IntRange(min=0), show_default=True,
              help="Seed of the splits and of all trainings.")  # fmt: skip
@click.option("--models", type=PATH, help="Folder of the models to score.  [default: shipped]")
@click.option("--touches", type=click.IntRange(min=200), default=6404, show_default=True, help="Touches to simulate.")
@click.option("--epochs", type=click.IntRange(min=1), help="Epochs of every training.  [default: the recipes']")
@click.option("--jobs", type=click.IntRange(min=1), help="Processes to use.  [default: one a core]")
@click.option("--dask", metavar="ADDRESS", help="Run on the workers of this Dask scheduler, such as tcp://host:8786.")
@click.option("--cache", type=PATH, help="Folder of finished results.  [default: user's cache]")
@click.option("--force", is_flag=True, help="Replace the report if it exists.")
def command(
    recording: Path | None,
    output: Path,
    layout: Path | None,
    seed: int,
    models: Path | None,
    touches: int,
    epochs: int | None,
    jobs: int | None,
    dask: str | None,
    cache: Path | None,
    force: bool,
) -> None:
    """Repeat the source paper's experiments on the digital twin, or on RECORDING, and write a report.

    It takes about an hour on two cores. A repeated command resumes a stopped run.
    """
    from touchd.cli.progress import Bars
    from touchd.files import replacing, writing
    from touchd.keypad import PHONE, load_layout
    from touchd.lab.reproduction.figures import draw
    from touchd.lab.reproduction.report import figures, page, store
    from touchd.lab.reproduction.run import Scale, reproduce
    from touchd.lab.reproduction.sets import check_touches
    from touchd.recording.format import read
    from touchd.training import train_network  # noqa: F401 - its jobs would miss PyTorch only after minutes
    from touchd.training.data.inspection import inspect
    from touchd.twin import cache as kept

    check_output(output, replace=force)
    given = read(recording) if recording else None
    if given is not None and given.contacts_mm is None:
        raise RecordingValues("no true contacts to train on", str(recording), "use a recording with contacts_mm")
    if given is not None:
        check_touches(given, str(recording))
    scale = Scale(touches=touches, epochs=epochs)
    if touches < scale.touches:
        part = touches / scale.touches
        scale = Scale(touches, max(200, round(part * scale.other_touches)), max(200, round(part * scale.held_out)),
                      epochs=epochs)  # fmt: skip
    keys = load_layout(layout or PHONE)
    with Bars() as bars:
        for text in inspect(given) if given is not None else ():
            bars.warn(text)

        def progress(what: str, done: int, steps: int) -> None:
            bars.update("reproduce", done, steps, what)

        results = reproduce(
            given, keys, seed=seed, scale=scale, models=models, progress=progress,
            workers=jobs, dask=dask, cache=cache or kept.folder() / "jobs",
        )  # fmt: skip
    made_by = "touchd reproduce" + (f" {recording.name}" if recording else "")
    # The stated command omits workers and cache: the results do not depend on them.
    stated = {"--layout": layout and layout.name, "--seed": seed or None, "--epochs": epochs}
    stated |= {"--touches": None if given or touches == Scale().touches else touches}
    made_by += "".join(f" {option} {value}" for option, value in stated.items() if value is not None)
    found = figures(results, made_by)
    folder = output.with_suffix("")
    with writing(folder):
        folder.mkdir(exist_ok=True)
    draw(results, folder)
    store(found, folder)
    with replacing(output) as file:
        file.write(page(found, output.stem).encode())
    click.echo(f"{output}: written, with its plots and figures in {folder}")
