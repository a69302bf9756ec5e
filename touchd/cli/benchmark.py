"""`touchd benchmark`: measure run time, latency and position error."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from touchd.cli.options import PATH
from touchd.files import check_output

if TYPE_CHECKING:
    from rich.console import Console

    from touchd.lab.benchmark.results import Run
    from touchd.training.report.template import Table

WIDTH, STEADY_WIDTH = 150, 225
"""Columns that the widest table needs."""


@click.command()
@click.option("--quick", is_flag=True, help="Measure fewer touches and frames, in about 20 s.")
@click.option("--json", "stored", type=PATH, metavar="FILE", help="Write the results to FILE.")
@click.option(
    "--compare", "other", type=PATH, metavar="FILE",
    help="Compare with a stored run: ratios to the paper's network.",
)  # fmt: skip
@click.option(
    "--docs", type=click.Path(path_type=Path, exists=True, file_okay=False), metavar="FOLDER",
    help="Write benchmarks.md, its plots and its results into FOLDER.",
)  # fmt: skip
@click.option("--from", "given", type=PATH, metavar="FILE", help="Show a stored run instead of measuring.")
@click.option(
    "--models", type=PATH, metavar="PATH",
    help="Folder of the models, or one model of the reference plate, by its own acquisition.  [default: shipped]",
)  # fmt: skip
@click.option(
    "--also", type=PATH, multiple=True, metavar="FILE",
    help="A further model of the reference plate, by USB; repeatable.",
)  # fmt: skip
@click.option(
    "--steady", is_flag=True, help="Measure steady rates alone: processor time, wake-ups, stages. Takes 12 minutes."
)
@click.option(
    "--against", type=click.Path(path_type=Path, exists=True, file_okay=False), metavar="FOLDER",
    help="With --steady: another checkout of touchd, run in turns with this one.",
)  # fmt: skip
def command(
    quick: bool,
    stored: Path | None,
    other: Path | None,
    docs: Path | None,
    given: Path | None,
    models: Path | None,
    also: tuple[Path, ...],
    steady: bool,
    against: Path | None,
) -> None:
    """Measure run time, latency and position error.

    The same simulated touches for every estimator; the daemon from a frame to a subscriber in another process; what
    each skip saves. Times are also relative to the source paper's network, so that runs on different computers compare.
    Leave the computer idle for three minutes.
    """
    if stored:
        check_output(stored)
    # Set before numpy is imported; child processes inherit it. Thread pools would add waiting times to the results.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if steady or against:
        if other or docs or given or models or also:
            raise click.UsageError("--steady and --against go with --quick and --json alone")
        _measure_steady(quick, against, stored)
        return
    from rich.console import Console

    from touchd.lab.benchmark import results

    stored_run = results.load(other) if other else None
    run = results.load(given) if given else _measured(quick, models, also)
    if stored:
        results.store(run, stored)
    # Rows stay on one line, in a pipe too.
    console = Console(width=max(Console().width, WIDTH))
    _show(console, run, stored_run)
    if docs:
        from touchd.lab.benchmark.page import write

        write(run, docs)
        click.echo(f"{docs / 'benchmarks.md'}: written, with its plots and results")


def _measure_steady(quick: bool, against: Path | None, stored: Path | None) -> None:
    from rich.console import Console

    from touchd.files import replacing
    from touchd.lab.benchmark import steady
    from touchd.lab.benchmark.results import this_machine
    from touchd.lab.benchmark.scenes import make_day, make_loop
    from touchd.twin.instrument import Instrument
    from touchd.twin.simulate import DEFAULT_PLATE

    instrument, machine = Instrument(DEFAULT_PLATE), this_machine()
    cells = steady.QUICK if quick else steady.CELLS
    loops = {
        scene: make_day(instrument) if scene == steady.DAY else make_loop(scene, instrument)
        for scene in {cell.scene for cell in cells}
    }
    found = steady.measure(
        loops, cells, against=against, turns=1 if quick else 5, seconds=1.0 if quick else steady.SECONDS,
        progress=lambda what: click.echo(what, err=True),
    )  # fmt: skip
    left_out = steady.left_out()
    if stored:
        with replacing(stored) as file:
            run = {"machine": machine.model_dump(), "cells": found, "left_out": left_out}
            file.write((json.dumps(run, indent=1) + "\n").encode())
    console = Console(width=max(Console().width, STEADY_WIDTH))
    console.print(machine.line(), highlight=False)
    for table in steady.tables(found):
        _print(console, table, names=2)
    for line in (*steady.LEGEND, *(f"Left out: {what}" for what in left_out)):
        console.print(line, highlight=False)


def _measured(quick: bool, models: Path | None, also: tuple[Path, ...]) -> Run:
    from touchd.cli.progress import Bars
    from touchd.lab.benchmark.measure import benchmark
    from touchd.localization.model import default_model_path

    # The bar draws on progress only: a refresh thread would disturb the measurement.
    with Bars(auto_refresh=False) as bars:

        def progress(what: str, done: float) -> None:
            bars.update("measure", round(100 * done), 100, what)

        return benchmark(models or default_model_path().parent, quick=quick, progress=progress, also=also)


def _show(console: Console, run: Run, other: Run | None) -> None:
    from touchd.lab.benchmark import tables

    console.print(run.machine.line(), highlight=False)
    made = [
        tables.estimator_table(run), tables.daemon_table(run), tables.share_table(run), tables.skip_table(run),
        tables.budget_table(run),
    ]  # fmt: skip
    if other is not None:
        made.append(tables.comparison_table(run, other))
    for table in made:
        if table.rows:
            _print(console, table)
    if run.day is not None:
        console.print(f"A typical day: {run.day.cpu_s_per_hour:.0f} s of processor time an hour", highlight=False)
    for what in run.left_out:
        console.print(f"Left out: {what}", highlight=False)


def _print(console: Console, table: Table, names: int = 1) -> None:
    from rich import box
    from rich.table import Table as RichTable

    shown = RichTable(title=table.title, box=box.SIMPLE, title_justify="left", pad_edge=False)
    for i, heading in enumerate(table.headings):
        shown.add_column(heading, justify="left" if i < names else "right", no_wrap=i < names)
    for row in table.rows:
        shown.add_row(*row)
    console.print(shown, highlight=False)
