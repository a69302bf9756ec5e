"""Place single touches of the twin, case by case, and write a row for each.

    python -m touchd.lab.study contacts|rigs -o FILE.csv [--touches N] [--seed N]

`contacts` are kinds of fingers, beside the bound for the same contacts; failures are per thousand touches. `rigs` are
effects of a real rig, one at a time. The model is as shipped: trained on the ideal rig, by a robot's silicone tip.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from touchd.config.schema import Settings
from touchd.evaluation.cramer_rao import median_distance_mm, position_covariance, residual_noise, twin_field
from touchd.evaluation.matching import Matches, match_frames, scores_by_fingers
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Recording
from touchd.twin.electronics import Electronics, Impulses, Ripple, Tone
from touchd.twin.instrument import Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.mounting import Mounting, feet
from touchd.twin.rig import IDEAL, Rig
from touchd.twin.simulate import DEFAULT_PLATE, simulate_touches

BLOCK = 200
"""Frames simulated at a time; the first block has the seed, the next has the next."""
BOUND_TOUCHES = 100
OFF_MM = 1.0
SCORES = (
    "median_mm", "p95_mm", "within_1_sigma", "within_2_sigma", "faces_told", "area_median", "area_p95",
    "major_median_mm", "major_p95_mm", "angle_median_deg", "angle_p95_deg",
)  # fmt: skip
"""Of `scores_by_fingers`, in the rows of `contacts`."""


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


def _electronics(**settings: object) -> Rig:
    return Rig(electronics=Electronics(**settings))  # type: ignore[arg-type]  # fields of Electronics


def _tilts(deg: float, db: float) -> Rig:
    return Rig(tilts=((deg, db), (-deg, db), (deg, -db), (-deg, -db)))


DRY_FEET = Mounting(attachments=feet(*DEFAULT_PLATE.size_mm, preload_n=1.2))
DRY_PADS = Mounting(left="pads", right="pads", top="pads", bottom="pads", preload_n=0.41)
"""Both carry a pane of 0.5 kg."""
NAMED = ", named"
"""Ends the name of an effect whose feet `model.feet_mm` names."""
EFFECTS = {
    "none": IDEAL,
    "jitter 5 ns": _electronics(jitter_s=5e-9),
    "jitter 20 ns": _electronics(jitter_s=20e-9),
    "jitter 100 ns": _electronics(jitter_s=100e-9),
    "impulses in 5 % of frames": _electronics(impulses=Impulses()),
    "impulses in 20 % of frames": _electronics(impulses=Impulses(share=0.2)),
    "tone through the finger -50 dB": _electronics(tones=(Tone(62_347.0, -50.0, finger=True),)),
    "ripple 0.1 %": _electronics(ripple=Ripple()),
    "ripple 1 %": _electronics(ripple=Ripple(share=0.01)),
    "crosstalk -50 dB": _electronics(crosstalk_db=-50.0),
    "nonlinearity 8 LSB": _electronics(inl_lsb=8.0),
    "tilts 10 deg 1.5 dB": _tilts(10.0, 1.5),
    "tilts 30 deg 3 dB": _tilts(30.0, 3.0),
    "feedthrough 0 dB": Rig(feedthrough=((0.0, 20.0), (-3.0, 200.0), (3.0, 60.0), (0.0, 340.0))),
    "resonances 0.5 % lower": Rig(stretch=-5e-3),
    "12 pads": Rig(mounting=Mounting(left="pads", right="pads", top="pads", bottom="pads")),
    "4 glued feet": Rig(mounting=Mounting(attachments=feet(*DEFAULT_PLATE.size_mm))),
    "4 dry feet": Rig(mounting=DRY_FEET),
    f"4 dry feet{NAMED}": Rig(mounting=DRY_FEET),
    "12 dry pads": Rig(mounting=DRY_PADS),
    f"12 dry pads{NAMED}": Rig(mounting=DRY_PADS),
    "tape on one edge": Rig(mounting=Mounting(left="tape")),
    "clamp on one edge": Rig(mounting=Mounting(left="clamped")),
    "bonded pane": Rig(mounting=Mounting(pane=True)),
}
"""Rigs by the name of their effect."""


def place(
    kind: Kind, rig: Rig, instrument: Instrument, touches: int, seed: int, model: Model,
    settings: Settings | None = None,
) -> tuple[Matches, dict[str, Any], Recording]:  # fmt: skip
    """Simulate touches, and place each as a touch-down on its own; return also the scores, and the first block."""
    seen, blocks, frames = [], [], -(-touches // kind.fingers)
    for number, start in enumerate(range(0, frames, BLOCK)):
        recording = simulate_touches(
            min(BLOCK, frames - start), seed=seed + number, instrument=instrument, electronics=rig.electronics,
            finger=kind.finger, fingers=kind.fingers, apart_mm=kind.apart_mm,
        )  # fmt: skip
        touched = touched_frames(recording)
        seen += see(find_with(model, model.atlas, touched, settings), touched)
        blocks.append(recording)
    matches = match_frames(seen)
    (scores,) = scores_by_fingers(matches).values()
    return matches, scores, blocks[0]


def contacts(name: str, touches: int, seed: int, model: Model) -> Iterator[dict[str, Any]]:
    """Yield the row of one of `KINDS`."""
    kind, instrument = KINDS[name], Instrument(DEFAULT_PLATE)
    matches, scores, first = place(kind, IDEAL, instrument, touches, seed, model)
    count = int(matches.fingers.sum())
    yield {
        "contact": name, "touches": count, "missed_per_1000": 1000 * (scores["missed"] / count),
        "wrong_number_per_1000": 1000 * (1 - scores["count_right"]),
        "off_by_more_than_1_mm_per_1000": 1000 * (float((matches.judged.distance_mm > OFF_MM).sum()) / count),
        **{what: scores[what] for what in SCORES},
        "bound_mm": bound(first, kind.finger, instrument) if kind.fingers == 1 else None,
    }  # fmt: skip


def bound(recording: Recording, finger: str, instrument: Instrument) -> float:
    """Return the Cramer-Rao bound of the median error of some touches, mm: for their own sizes and shapes."""
    assert recording.contacts_mm is not None and recording.faces is not None  # noqa: PT018 - the twin labels both
    down = np.flatnonzero(np.isfinite(recording.contacts_mm[:, 0, 0]))[:BOUND_TOUCHES]
    touching = [
        Contact(x, y, np.pi / 4 * major * minor, finger, major / minor, np.radians(deg))
        for (x, y), (major, minor, deg) in zip(
            recording.contacts_mm[down, 0].tolist(), recording.faces[down, 0].tolist(), strict=True
        )
    ]
    field = twin_field(instrument, touching)
    return median_distance_mm(position_covariance(field, recording.acquisition, residual_noise(recording)))


def rigs(name: str, touches: int, seed: int, model: Model) -> Iterator[dict[str, Any]]:
    """Yield the rows of one of `EFFECTS`: a silicone tip's, a fingertip's and a glove's."""
    rig = EFFECTS[name]
    feet_mm = [foot.middle_mm for foot in rig.mounting.on(DEFAULT_PLATE)] if name.endswith(NAMED) else []
    settings = Settings.model_validate({"model": {"feet_mm": feet_mm}})
    for contact in ("silicone tip", "fingertip", "glove"):
        scores = place(KINDS[contact], rig, rig.instrument(DEFAULT_PLATE), touches, seed, model, settings)[1]
        yield {
            "effect": name, "contact": contact, "touches": touches, "right_number": scores["count_right"],
            "median_mm": scores["median_mm"], "p95_mm": scores["p95_mm"], "within_1_mm": scores["all_within_1_mm"],
        }  # fmt: skip


STUDIES: dict[str, tuple[Callable[..., Iterator[dict[str, Any]]], tuple[str, ...]]] = {
    "contacts": (contacts, tuple(KINDS)),
    "rigs": (rigs, tuple(EFFECTS)),
}


@click.command()
@click.argument("study", type=click.Choice(list(STUDIES)))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The table to write (.csv).")
@click.option("--touches", default=1000, show_default=True, type=click.IntRange(min=1), help="Fingers of each row.")
@click.option("--seed", default=7000, show_default=True, help="Of touches that neither training nor thresholds saw.")
def command(study: str, output: Path, touches: int, seed: int) -> None:
    """Measure all cases of STUDY, and write their rows as they are known."""
    rows_of, cases = STUDIES[study]
    model = Model(default_model_path())
    with output.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        for case in cases:
            for row in rows_of(case, touches, seed, model):
                if not file.tell():
                    table.writerow(row)
                table.writerow([f"{value:.3g}" if isinstance(value, float) else value for value in row.values()])
                file.flush()


if __name__ == "__main__":
    command()
