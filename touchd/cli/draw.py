"""`touchd draw`: a picture of a replayed session."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The picture to write (PNG).")
@click.option("--model", type=click.Path(path_type=Path), help="The model to use.")
def command(recording: Path, output: Path, model: Path | None) -> None:
    """Replay RECORDING and draw its true touches with the contacts that were found."""
    from touchd.config.load import load
    from touchd.evaluation.plots.session import draw_session
    from touchd.recording.format import read
    from touchd.service.replay import replay

    settings = load(None, {"model": {"path": model}} if model else {})
    outcome = replay(recording, settings)
    draw_session(read(recording), outcome.touches, output)
    click.echo(f"{output}: {len(outcome.touches)} messages drawn")
