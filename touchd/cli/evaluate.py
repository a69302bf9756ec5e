"""`touchd evaluate`: score a model on a labelled recording."""

from __future__ import annotations

import json
from contextlib import suppress
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import click
import numpy as np

from touchd.cli.options import PATH, STREAM_HZ, check_picture, warn_of_other_plate
from touchd.cli.progress import Bars
from touchd.config.load import load
from touchd.config.schema import Settings
from touchd.errors import RecordingValues, TrainingError
from touchd.evaluation.matching import Matches, match_frames, scores_by_fingers
from touchd.evaluation.metrics import position_scores
from touchd.evaluation.model_scores import Judgement, judge, scores
from touchd.evaluation.single_frames import find_with, network_features, see, touched_frames
from touchd.lab.replay_parts import score
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.recording.format import Reader, read


@click.command()
@click.argument("model", type=PATH)
@click.argument("recording", type=PATH)
@click.option("--json", "as_json", is_flag=True, help="Print the scores as one JSON object.")
@click.option(
    "--plot", type=PATH, metavar="FILE.png",
    help="Of single frames: plot position error and bias over the plate, or the confusion of zones or keys.",
)  # fmt: skip
@click.option(
    "--jobs", type=click.IntRange(min=1), metavar="N", help="Processes for hours of frames.  [default: all cores]"
)
def command(model: Path, recording: Path, as_json: bool, plot: Path | None, jobs: int | None) -> None:
    """Score MODEL on RECORDING, which must be labelled with true contacts.

    A recording of 20 frames/s or more is replayed through the pipeline; a folder of hours in parts, on all cores, and
    after Ctrl-C the same command goes on from the parts that have ended. A slower one is scored frame by frame: each
    touched frame is compared with the untouched frames beside it. The field atlas beside the model is used if there is
    one. docs/plate-maker.md explains each score.
    """
    if plot is not None:
        check_picture(plot)
    meta = Reader(recording).meta
    loaded = Model(model)
    warn_of_other_plate(loaded.description, meta)
    if meta.frame_rate_hz >= STREAM_HZ:
        if plot is not None:
            raise click.UsageError("--plot needs a recording below 20 frames/s; touchd draw plots a stream")
        found = _score_replay(recording, load(None, {"model": {"path": model}}), jobs)
    else:
        truth = read(recording)
        if truth.contacts_mm is None:
            raise RecordingValues(
                "no true contacts to compare with", str(recording), "use a recording with contacts_mm"
            )
        loaded.check(truth.acquisition)
        found = _score_frames(truth, loaded, plot)
    click.echo(json.dumps(found) if as_json else _table(found))


def _score_replay(path: Path, settings: Settings, jobs: int | None) -> dict[str, Any]:
    with Bars() as bars:
        result = score(path, settings, workers=jobs, progress=partial(bars.update, "frames"))
    names = ("touches", "found", "missed", "ghosts", "split", "switches", "down_latency_ms", "jitter_mm")
    return _positions(result.error_mm) | {name: getattr(result, name) for name in names} | {
        "moving_rmse_mm": _positions(result.error_mm[result.moving])["rmse_mm"],
        "by_fingers": scores_by_fingers(result.settled),
    }  # fmt: skip


def _score_frames(truth: Recording, model: Model, plot: Path | None) -> dict[str, Any]:
    d = model.description
    frames = touched_frames(truth)
    seen = see(find_with(model, model.atlas, frames), frames)
    matches = match_frames(seen)
    alone = [s for s in seen if len(s.true_mm) == 1]
    if d.head == "regression":
        # Take the nearest contact at any distance: a single finger has one position.
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
            from touchd.evaluation.cramer_rao import median_bound_mm  # with scipy's optimisers: half a second

            # The bound uses the atlas' own field, since a rig has no other; the twin's true field differs by a few %.
            with suppress(TrainingError):  # too few untouched frames tell no noise
                found["bound_mm"] = median_bound_mm(truth, model.atlas)
                found["times_bound"] = found["median_mm"] / found["bound_mm"]
    return found | {"by_fingers": scores_by_fingers(matches)}


def _draw(judged: Judgement, matches: Matches, model: Model, truth: Recording, picture: Path) -> None:
    # Import matplotlib only for a plot.
    from touchd.evaluation.plots.maps import draw_maps, draw_zones
    from touchd.evaluation.plots.model import draw_confusion
    from touchd.evaluation.plots.session import save

    d = model.description
    several = d.head == "regression" and matches.fingers.max() > 1
    drawn = matches.judged if several else judged
    if not len(drawn.true_mm):
        raise RecordingValues("no contact to plot", "contacts_mm", "score without --plot")
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
    """Format the scores: a line each, then a column for each number of fingers."""
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
    return position_scores(error_mm) | {"n": len(error_mm)}
