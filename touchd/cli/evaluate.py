"""`touchd evaluate`: how good a model is on a labelled recording."""

from __future__ import annotations

import json
from math import inf
from pathlib import Path
from typing import Any

import click
import numpy as np

from touchd.config.load import load
from touchd.config.schema import Settings
from touchd.errors import RecordingValues
from touchd.evaluation.cramer_rao import median_bound_mm
from touchd.evaluation.matching import Matches, match_frames, scores_by_fingers
from touchd.evaluation.metrics import position_scores
from touchd.evaluation.model_scores import Judgement, judge, scores
from touchd.evaluation.replay_scores import score_stream
from touchd.evaluation.single_frames import find_with, network_features, see, touched_frames
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.recording.format import read
from touchd.service.replay import replay

STREAM_HZ = 20.0
"""Slower recordings hold touches one by one, each judged on its own frame."""


@click.command()
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print the scores as one JSON object.")
@click.option(
    "--plot", type=click.Path(path_type=Path), metavar="FILE.png",
    help="Draw errors and bias over the plate, or which zone or key was taken for which.",
)  # fmt: skip
def command(model: Path, recording: Path, as_json: bool, plot: Path | None) -> None:
    """Score MODEL on RECORDING, which must hold the truth.

    A recording of 20 frames a second or more is replayed through the whole pipeline: its touches are found, missed,
    invented (ghosts) or split, a contact that goes on as another finger switches, down_latency_ms is the median time
    from a touch's first frame to its first message, and jitter_mm is how far the positions of a still finger scatter.
    In a slower recording each touch is judged on its own frame, against the untouched frames beside it, by the field
    atlas beside the model if there is one; a grid or keypad model is scored by its zones or keys too.

    The positions above are those of a replay's messages, or of frames with a single finger. by_fingers has the frames
    with none, one, two, ... fingers, whose contacts are assigned to the fingers with the least total distance, within
    25 mm: the share with the right number of contacts, fingers missed, ghosts, distances, and the share with each
    finger within 1 and 2 mm, told apart from the others; the share of errors within 1 and 2 sigma; and how well the
    force follows the true one.

    With a field atlas bound_mm is the Cramer-Rao bound of the median error of single fingers, below which no estimate
    gets, and times_bound how many times that the median is.
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
        loaded.check(truth.acquisition)
        found = _score_frames(truth, loaded, plot)
    click.echo(json.dumps(found) if as_json else _table(found))


def _score_replay(path: Path, truth: Recording, settings: Settings) -> dict[str, Any]:
    result = score_stream(truth, replay(path, settings).touches)
    return _positions(result.error_mm) | {
        "touches": result.touches,
        "found": result.found,
        "missed": result.missed,
        "ghosts": result.ghosts,
        "split": result.split,
        "switches": result.switches,
        "down_latency_ms": result.down_latency_ms,
        "jitter_mm": result.jitter_mm,
        "moving_rmse_mm": _positions(result.error_mm[result.moving])["rmse_mm"],
        "by_fingers": scores_by_fingers(result.settled),
    }


def _score_frames(truth: Recording, model: Model, plot: Path | None) -> dict[str, Any]:
    d = model.description
    if d.plate != truth.meta.plate:
        click.echo(
            f"touchd: warning: the model is for the plate {d.plate}, the recording is of the plate {truth.meta.plate}",
            err=True,
        )
    frames = touched_frames(truth)
    seen = see(find_with(model, model.atlas, frames), frames)
    matches = match_frames(seen)
    alone = [s for s in seen if len(s.true_mm) == 1]
    if d.head == "regression":
        # However far off it is, the nearest contact of a single finger is its place.
        judged = match_frames(alone, reach_mm=inf).judged
    else:
        true_mm = np.array([s.true_mm[0] for s in alone], np.float32).reshape(-1, 2)
        features = network_features(model, frames)[frames.fingers == 1]
        judged = judge(model, features, true_mm, frames.noise_energy())
    if plot is not None:
        _draw(judged, matches, model, truth, plot)
    found: dict[str, Any] = {"n": 0, "rmse_mm": None}
    if len(judged.true_mm):
        found = scores(judged) | {"n": len(judged.true_mm)}
        if model.atlas is not None:
            # From the atlas' own field, which is all that is known of a rig: the true one would say the same to some %.
            found["bound_mm"] = median_bound_mm(truth, model.atlas)
            found["times_bound"] = found["median_mm"] / found["bound_mm"]
    return found | {"by_fingers": scores_by_fingers(matches)}


def _draw(judged: Judgement, matches: Matches, model: Model, truth: Recording, picture: Path) -> None:
    # matplotlib is loaded only where a picture is wanted.
    from touchd.evaluation.plots.maps import draw_maps, draw_zones
    from touchd.evaluation.plots.model import draw_confusion
    from touchd.evaluation.plots.session import save

    d = model.description
    several = d.head == "regression" and matches.fingers.max() > 1
    drawn = matches.judged if several else judged
    if not len(drawn.true_mm):
        raise RecordingValues("there is no contact to draw", "contacts_mm", "score without --plot")
    if d.head == "grid":
        figure = draw_zones(judged, d, truth.meta)
    elif d.head == "keypad":
        figure = draw_confusion(judged, d)
    else:
        missed = int(matches.fingers.sum()) - len(matches.frame)
        ghosts = int(matches.contacts.sum()) - len(matches.frame)
        counts = " or ".join(map(str, np.unique(matches.fingers)))
        remark = f"{len(matches.fingers)} frames with {counts} fingers: {missed} missed, {ghosts} ghosts"
        figure = draw_maps(drawn, truth.meta, remark if several else "")
    save(figure, picture)


def _table(found: dict[str, Any]) -> str:
    """Return the scores for a person: a line each, then a column for each count of fingers."""
    by_fingers: dict[str, dict[str, Any]] = found["by_fingers"]
    lines = [f"{name:17} {_number(value):>10}" for name, value in found.items() if name != "by_fingers"]
    if by_fingers:
        lines += ["", f"{'fingers':17}" + "".join(f" {count:>10}" for count in by_fingers)]
        names = list(dict.fromkeys(name for scores in by_fingers.values() for name in scores))
        for name in names:
            lines.append(f"{name:17}" + "".join(f" {_number(scores.get(name)):>10}" for scores in by_fingers.values()))
    return "\n".join(lines)


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _positions(error_mm: np.ndarray) -> dict[str, Any]:
    if not len(error_mm):
        return {"n": 0, "rmse_mm": None}
    scores: dict[str, Any] = dict(position_scores(error_mm))
    return scores | {"n": int(scores["n"])}
