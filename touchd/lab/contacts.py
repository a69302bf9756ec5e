"""How well each kind of contact is placed, touch-down by touch-down, beside the bound for the same contacts.

    python -m touchd.lab.contacts -o FILE.csv [--touches N] [--seed N] [--model MODEL.onnx] [KIND ...]

The model is as shipped, learned from a robot's silicone tip; failures are per thousand touches.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from touchd.evaluation.cramer_rao import median_distance_mm, position_covariance, residual_noise, twin_field
from touchd.evaluation.matching import Matches, Seen, match_frames, scores_by_fingers
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Recording
from touchd.twin.instrument import Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.simulate import DEFAULT_PLATE, simulate_touches

BLOCK = 200
"""Touches simulated at a time."""
BOUND_TOUCHES = 100
OFF_MM = 1.0


class Kind(NamedTuple):
    """What touches the plate."""

    finger: str
    fingers: int = 1
    apart_mm: float = 0.0


KINDS = {
    "rigid disc": Kind("silicone"),
    "silicone tip": Kind("robot"),
    "child": Kind("child"),
    "fingertip": Kind("fingertip"),
    "thumb": Kind("thumb"),
    "glove": Kind("glove"),
    "two fingertips": Kind("fingertip", 2, 16.0),
    "five fingertips": Kind("fingertip", 5, 25.0),
}


def measure(name: str, frames: int, seed: int, model: Model, instrument: Instrument) -> dict[str, Any]:
    """Return a row of a kind: `frames` touch-downs, each of its number of fingers."""
    kind, seen, bound_mm = KINDS[name], [], None
    for number, first in enumerate(range(0, frames, BLOCK)):
        recording = simulate_touches(
            min(BLOCK, frames - first), seed=seed + number, instrument=instrument, finger=kind.finger,
            fingers=kind.fingers, apart_mm=kind.apart_mm,
        )  # fmt: skip
        touched = touched_frames(recording)
        seen += see(find_with(model, model.atlas, touched), touched)
        if not number and kind.fingers == 1:
            bound_mm = bound(recording, kind.finger, instrument)
    return {"contact": name, "touches": frames * kind.fingers} | _scores(seen) | {"bound_mm": bound_mm}


def bound(recording: Recording, finger: str, instrument: Instrument) -> float:
    """Return the Cramer-Rao bound of the median error of some touches, mm: for their own sizes and shapes."""
    assert recording.contacts_mm is not None and recording.faces is not None  # noqa: PT018 - the twin labels both
    down = np.flatnonzero(np.isfinite(recording.contacts_mm[:, 0, 0]))[:BOUND_TOUCHES]
    contacts = [
        Contact(x, y, np.pi / 4 * major * minor, finger, major / minor, np.radians(deg))
        for (x, y), (major, minor, deg) in zip(
            recording.contacts_mm[down, 0].tolist(), recording.faces[down, 0].tolist(), strict=True
        )
    ]
    field = twin_field(instrument, contacts)
    return median_distance_mm(position_covariance(field, recording.acquisition, residual_noise(recording)))


def _scores(seen: list[Seen]) -> dict[str, Any]:
    matches: Matches = match_frames(seen)
    (scores,) = scores_by_fingers(matches).values()
    touches, frames = int(matches.fingers.sum()), len(seen)
    found = {
        "missed": scores["missed"] / touches, "wrong_number": 1 - scores["count_right"],
        "off_by_more_than_1_mm": float((matches.judged.distance_mm > OFF_MM).sum()) / touches,
    }  # fmt: skip
    assert frames == scores["n"]
    return {f"{name}_per_1000": 1000 * share for name, share in found.items()} | {
        name: scores[name]
        for name in (
            "median_mm", "p95_mm", "within_1_sigma", "within_2_sigma", "faces_told", "area_median", "area_p95",
            "major_median_mm", "major_p95_mm", "angle_median_deg", "angle_p95_deg",
        )
    }  # fmt: skip


@click.command()
@click.argument("kinds", nargs=-1, type=click.Choice(list(KINDS)), metavar="[KIND]...")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The table to write (.csv).")
@click.option("--touches", default=2000, show_default=True, type=click.IntRange(min=5), help="Fingers of each kind.")
@click.option("--seed", default=7000, show_default=True, help="Of the first block of touches; the next have the next.")
@click.option("--model", type=click.Path(path_type=Path), help="Network beside its atlas.  [default: shipped]")
def command(kinds: tuple[str, ...], output: Path, touches: int, seed: int, model: Path | None) -> None:
    """Measure each KIND, by default all, and write its row as it is known."""
    loaded, instrument = Model(model or default_model_path()), Instrument(DEFAULT_PLATE)
    with output.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        for number, name in enumerate(kinds or KINDS):
            row = measure(name, -(-touches // KINDS[name].fingers), seed, loaded, instrument)
            if not number:
                table.writerow(row)
            table.writerow([f"{value:.3g}" if isinstance(value, float) else value for value in row.values()])
            file.flush()


if __name__ == "__main__":
    command()
