"""`touchd draw`: plot a replayed session."""

from __future__ import annotations

from pathlib import Path

import click

from touchd.cli.options import PATH, check_picture, warn_of_other_plate, warn_of_single_frames


@click.command()
@click.argument("recording", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="The plot to write, such as .png or .svg.")
@click.option("--model", type=PATH, help="Model (ONNX).  [default: shipped]")
def command(recording: Path, output: Path, model: Path | None) -> None:
    """Replay RECORDING and plot the published contacts over its true touches."""
    from touchd.config.load import load
    from touchd.evaluation.plots.session import draw_session
    from touchd.localization.model import default_model_path
    from touchd.recording.format import read
    from touchd.service.models import load_model
    from touchd.service.replay import replay

    check_picture(output)
    settings = load(None, {"model": {"path": model or default_model_path()}})
    truth, loaded = read(recording), load_model(settings)
    warn_of_other_plate(loaded.description, truth.meta)
    warn_of_single_frames(truth.meta)
    outcome = replay(recording, settings, loaded)
    draw_session(truth, outcome.touches, output)
    click.echo(f"{output}: {len(outcome.touches)} messages drawn")
