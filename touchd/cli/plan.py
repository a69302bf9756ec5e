"""`touchd plan`: draw the expected error of a layout of discs over a plate, and suggest a better one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchd.cli.options import PATH, NumberRange, check_picture, json_option
from touchd.cli.simulate import acquisition_option
from touchd.frame import Acquisition

if TYPE_CHECKING:
    from touchd.calibration.plan import Plan


@click.command()
@click.argument("plate_file", type=PATH, metavar="PLATE.toml")
@acquisition_option
@click.option(
    "--noise-db",
    type=NumberRange(-20, 200),
    default=60.0,
    show_default=True,
    help="Signal-to-noise ratio of the untouched plate, dB.",
)
@click.option("-o", "--output", type=PATH, metavar="FILE.png", help="Draw both maps.")
@json_option
def command(plate_file: Path, acquisition: Acquisition, noise_db: float, output: Path | None, as_json: bool) -> None:
    """Compute a fingertip's expected error over the plate of PLATE.toml, and move the discs to make it smaller.

    It is the bound that noise sets, from physics at the values of PLATE.toml; errors of the fitted physics come on top.
    A disc that moves keeps off the plate's axes, and off the mirror images of others; one that stays may lie there.
    """
    from touchd.calibration.plan import PlateMap
    from touchd.calibration.plate_file import read_plate_file
    from touchd.calibration.untouched import check_chirp
    from touchd.cli.progress import Bars

    if output is not None:
        check_picture(output)
    said = read_plate_file(plate_file)
    check_chirp(acquisition, "--acquisition")
    here = PlateMap(said, acquisition.model_copy(update={"channels": len(said.discs.receivers_mm)}), noise_db)
    given = here.plan(said.layout().centres_mm)
    with Bars() as bars:
        better = here.suggest(given, progress=lambda share: bars.update("layouts", round(100 * share), 100))
    plans = {"given": given, "suggested": better}
    if output is not None:
        from touchd.calibration.calibrate import draw_expected
        from touchd.evaluation.plots.session import save

        save(draw_expected(said.twin_plate(), {name: (p.error_mm, p.discs_mm) for name, p in plans.items()}), output)
    found = {name: _told(plan) for name, plan in plans.items()}
    click.echo(json.dumps(found) if as_json else _text(found))


def _told(plan: Plan) -> dict[str, Any]:
    median, p95, worst = plan.quantiles_mm
    return {
        "emitter_mm": plan.discs_mm[0].tolist(), "receivers_mm": plan.discs_mm[1:].tolist(),
        "median_mm": median, "p95_mm": p95, "worst_mm": worst, "exact_mm": plan.exact_mm,
    }  # fmt: skip


def _text(found: dict[str, dict[str, Any]]) -> str:
    lines = ["fingertip, error by noise, mm:", f"{'layout':12}{'median':>9}{'95 %':>9}{'worst':>9}"]
    for name, told in found.items():
        lines.append(f"{name:12}{told['median_mm']:9.4f}{told['p95_mm']:9.4f}{told['worst_mm']:9.4f}")
    better = found["suggested"]
    lines += [
        f"Exact physics leave about {better['exact_mm']:.2f} mm beside it.", "",
        f"emitter_mm = {better['emitter_mm']}", f"receivers_mm = {better['receivers_mm']}",
    ]  # fmt: skip
    return "\n".join(lines)
