"""`touchd check`: judge a model on anybody's touches."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from touchd.cli.options import PATH, config_option, json_option

if TYPE_CHECKING:
    from touchd.calibration.check import Checked


@click.command()
@click.argument("model", type=PATH)
@click.argument("recording", type=PATH)
@json_option
@config_option
def command(model: Path, recording: Path, as_json: bool, config: Path | None) -> None:
    """Judge MODEL on RECORDING, a minute of anybody's touches and strokes.

    Nobody needs to know where they were. Says whether the plate should be calibrated again, and why; and where a foot
    that nothing glues may answer touches elsewhere, unless the configuration names it. RECORDING begins untouched.
    """
    from touchd.calibration.check import check_model
    from touchd.config.load import load

    checked = check_model(model, recording, load(config).model.feet_mm)
    click.echo(json.dumps(asdict(checked)) if as_json else _text(checked))


def _text(checked: Checked) -> str:
    lines = [checked.verdict, *(f"  {reason}" for reason in checked.reasons)]
    lines.append(
        f"  {checked.touches} touches; the median one leaves {checked.unexplained:.2%} of its energy unexplained"
    )
    if checked.apart_mm is not None:
        lines.append(
            f"  halves of the band place a touch {checked.apart_mm:.2f} mm apart, {checked.expected_apart_mm:.2f} mm "
            f"expected; estimated error {checked.error_mm:.2f} mm"
        )
    if checked.bent_mm is not None:
        lines.append(f"  strokes leave a smooth line by {checked.bent_mm:.2f} mm RMS")
    return "\n".join(lines)
