"""`touchd evaluate`: how good a model is on a labelled recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import numpy as np

from touchd.config import Settings
from touchd.configfile import load
from touchd.errors import RecordingValues
from touchd.evaluation.metrics import position_scores
from touchd.evaluation.replay import replay
from touchd.evaluation.score import Judgement, judge, scores
from touchd.evaluation.stream import score_stream
from touchd.model import Model
from touchd.recording import Recording, read
from touchd.training.dataset import make_dataset

STREAM_HZ = 20.0
"""Slower recordings hold touches one by one, each judged on its own frame."""


@click.command()
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print the scores as one JSON object.")
@click.option(
    "--plot", type=click.Path(path_type=Path), metavar="FILE.png",
    help="Draw the errors over the plate, or which zone or key was taken for which.",
)  # fmt: skip
def command(model: Path, recording: Path, as_json: bool, plot: Path | None) -> None:
    """Score MODEL on RECORDING, which must hold the truth.

    A recording of 20 frames a second or more is replayed through the whole pipeline: its touches are found, missed,
    invented (ghosts) or split, down_latency_ms is the median time from a touch's first frame to its first message, and
    jitter_mm is how far the positions of a still finger scatter. In a slower recording each touch is judged on its own
    frame, against the untouched frames beside it; a grid or keypad model is scored by its zones or keys too.
    """
    truth = read(recording)
    if truth.contacts_mm is None:
        raise RecordingValues("there is no truth to compare with", str(recording), "use a recording with contacts_mm")
    if truth.meta.frame_rate_hz >= STREAM_HZ:
        if plot is not None:
            raise click.UsageError("--plot is for touches one by one; touchd draw draws a stream")
        found = _score_replay(recording, truth, load(None, {"model": {"path": model}}))
    else:
        loaded = Model(model)
        judged = _judge_touches(truth, loaded)
        found = scores(judged)
        found["n"] = len(judged.true_mm)
        if plot is not None:
            _draw(judged, loaded, truth, plot)
    if as_json:
        click.echo(json.dumps(found))
        return
    for name, value in found.items():
        click.echo(
            f"{name:17} {value:8.3f}"
            if isinstance(value, float)
            else f"{name:17} {value if value is not None else '-':>8}"
        )


def _score_replay(path: Path, truth: Recording, settings: Settings) -> dict[str, Any]:
    result = score_stream(truth, replay(path, settings).touches)
    return _positions(result.error_mm) | {
        "touches": result.touches,
        "found": result.found,
        "missed": result.missed,
        "ghosts": result.ghosts,
        "split": result.split,
        "down_latency_ms": result.down_latency_ms,
        "jitter_mm": result.jitter_mm,
        "moving_rmse_mm": _positions(result.error_mm[result.moving])["rmse_mm"],
    }


def _judge_touches(truth: Recording, model: Model) -> Judgement:
    model.check(truth.acquisition)
    mine, its = model.description.plate, truth.meta.plate
    if mine != its:
        click.echo(f"touchd: warning: the model is for the plate {mine}, the recording is of the plate {its}", err=True)
    data = make_dataset(truth, model.description.domain, least=1)
    features = data.residual if model.description.input == "residual" else data.signal
    return judge(model, features, data.position_mm)


def _draw(judged: Judgement, model: Model, truth: Recording, picture: Path) -> None:
    # matplotlib is loaded only where a picture is wanted.
    from touchd.evaluation.modelplots import draw_confusion, draw_error_map, draw_zones
    from touchd.evaluation.plots import save

    d = model.description
    if d.head == "grid":
        figure = draw_zones(judged, d, truth.meta)
    elif d.head == "keypad":
        figure = draw_confusion(judged, d)
    else:
        figure = draw_error_map(judged, truth.meta)
    save(figure, picture)


def _positions(error_mm: np.ndarray) -> dict[str, Any]:
    if not len(error_mm):
        return {"n": 0, "rmse_mm": None}
    scores: dict[str, Any] = dict(position_scores(error_mm))
    return scores | {"n": int(scores["n"])}
