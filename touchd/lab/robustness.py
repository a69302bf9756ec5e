"""What a real rig's effects cost: right number of fingers, median and 95th percentile, one effect a row.

    python -m touchd.lab.robustness -o FILE.csv [--touches N] [--model MODEL.onnx] [EFFECT ...]

Touches of a silicone tip and of fingertips, each frame a touch-down, placed by a model that was trained on the ideal
rig. Mounting and tilts came after training.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import click

from touchd.evaluation.matching import match_frames, scores_by_fingers
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.localization.model import Model, default_model_path
from touchd.twin.electronics import Electronics, Impulses, Tone
from touchd.twin.physics.mounting import Mounting
from touchd.twin.rig import IDEAL, Rig
from touchd.twin.simulate import DEFAULT_PLATE, simulate_touches

SEED = 8100
"""Of touches that neither training nor thresholds saw; each effect has the next one."""
CONTACTS = {"silicone tip": "robot", "fingertip": "fingertip"}


def _electronics(**settings: object) -> Rig:
    return Rig(electronics=Electronics(**settings))  # type: ignore[arg-type]  # fields of Electronics


def _tilts(deg: float, db: float) -> Rig:
    return Rig(tilts=((deg, db), (-deg, db), (deg, -db), (-deg, -db)))


EFFECTS = {
    "none": IDEAL,
    "jitter 5 ns": _electronics(jitter_s=5e-9),
    "jitter 20 ns": _electronics(jitter_s=20e-9),
    "jitter 100 ns": _electronics(jitter_s=100e-9),
    "impulses in 5 % of frames": _electronics(impulses=Impulses()),
    "impulses in 20 % of frames": _electronics(impulses=Impulses(share=0.2)),
    "tone through the finger -50 dB": _electronics(tones=(Tone(62_347.0, -50.0, finger=True),)),
    "crosstalk -50 dB": _electronics(crosstalk_db=-50.0),
    "nonlinearity 8 LSB": _electronics(inl_lsb=8.0),
    "tilts 10 deg 1.5 dB": _tilts(10.0, 1.5),
    "tilts 30 deg 3 dB": _tilts(30.0, 3.0),
    "12 pads": Rig(mounting=Mounting(left="pads", right="pads", top="pads", bottom="pads")),
    "tape on one edge": Rig(mounting=Mounting(left="tape")),
    "clamp on one edge": Rig(mounting=Mounting(left="clamped")),
    "bonded pane": Rig(mounting=Mounting(pane=True)),
}
"""Rigs by the name of their effect."""


class Row(NamedTuple):
    """What came of the touches of one contact on one rig."""

    effect: str
    contact: str
    touches: int
    right_number: float
    median_mm: float | None
    p95_mm: float | None
    within_1_mm: float


def measure(effect: str, touches: int, model: Model) -> Iterator[Row]:
    """Yield a row for each contact on a rig of `EFFECTS`."""
    rig = EFFECTS[effect]
    instrument = rig.instrument(DEFAULT_PLATE)
    seed = SEED + list(EFFECTS).index(effect)
    for contact, finger in CONTACTS.items():
        recording = simulate_touches(
            touches, seed=seed, instrument=instrument, electronics=rig.electronics, finger=finger
        )
        frames = touched_frames(recording)
        scores = scores_by_fingers(match_frames(see(find_with(model, model.atlas, frames), frames)))["1"]
        yield Row(
            effect, contact, touches, scores["count_right"], scores.get("median_mm"), scores.get("p95_mm"),
            scores["all_within_1_mm"],
        )  # fmt: skip


@click.command()
@click.argument("effects", nargs=-1, type=click.Choice(list(EFFECTS)), metavar="[EFFECT]...")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The table to write (.csv).")
@click.option("--touches", default=200, show_default=True, type=click.IntRange(min=1), help="Of each row.")
@click.option("--model", type=click.Path(path_type=Path), help="Network beside its atlas.  [default: shipped]")
def command(effects: tuple[str, ...], output: Path, touches: int, model: Path | None) -> None:
    """Measure each EFFECT, by default all, and write a row for each contact as it is known."""
    loaded = Model(model or default_model_path())
    with output.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(Row._fields)
        for effect in effects or EFFECTS:
            for row in measure(effect, touches, loaded):
                table.writerow([f"{value:.3g}" if isinstance(value, float) else value for value in row])
                file.flush()


if __name__ == "__main__":
    command()
