"""Each touched frame is shown to the shipped field atlas, as the daemon would show it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from touchd.cli.evaluate import command
from touchd.evaluation.matching import match_frames, scores_by_fingers
from touchd.evaluation.single_frames import TouchedFrames, find_with, see, touched_frames
from touchd.localization.atlas import Atlas, atlas_path, save_atlas
from touchd.localization.model import Model, default_model_path
from touchd.recording.format import write
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

MARGIN_MM = 55.0
"""The middle of the plate says it as well as all of it."""


@pytest.fixture(scope="module")
def atlas(atlas_model: Model) -> Atlas:
    assert atlas_model.atlas is not None
    return atlas_model.atlas


@pytest.fixture(scope="module")
def known(instrument: Instrument) -> dict[str, TouchedFrames]:
    options = {"1": {"fingers": 1}, "2": {"fingers": 2, "apart_mm": 30.0}}
    return {
        key: touched_frames(simulate_touches(60, seed=41, instrument=instrument, margin_mm=MARGIN_MM, **more))  # type: ignore[arg-type]  # options
        for key, more in options.items()
    }


def test_one_finger(atlas: Atlas, model: Model, known: dict[str, TouchedFrames]) -> None:
    """The atlas places one finger far finer than its network."""
    fine = scores_by_fingers(match_frames(see(find_with(model, atlas, known["1"]), known["1"])))["1"]
    rough = scores_by_fingers(match_frames(see(find_with(model, None, known["1"]), known["1"])))["1"]
    print(f"median {1e3 * fine['median_mm']:.0f} and {1e3 * rough['median_mm']:.0f} um")
    assert fine["count_right"] == 1
    assert fine["median_mm"] < 0.05 < 5 * fine["median_mm"] < rough["median_mm"]
    assert fine["force_rank"] > 0.99
    assert fine["force_spread_p95"] < 0.1


def test_two_fingers(atlas: Atlas, model: Model, known: dict[str, TouchedFrames]) -> None:
    """The atlas finds two fingers."""
    fine = scores_by_fingers(match_frames(see(find_with(model, atlas, known["2"]), known["2"])))["2"]
    assert fine["all_within_1_mm"] > 0.9
    assert fine["missed"] <= 2


def test_any_order(atlas: Atlas, model: Model, known: dict[str, TouchedFrames]) -> None:
    """Each frame is a touch-down: in any order the same is found."""
    find = find_with(model, atlas, known["1"])
    there = [find(i) for i in range(20)]
    back = [find(i) for i in reversed(range(20))]
    assert there == back[::-1]


def test_verb(atlas: Atlas, instrument: Instrument, tmp_path: Path) -> None:
    """`touchd evaluate` takes the atlas beside the model."""
    path = Path(shutil.copy(default_model_path(), tmp_path / "plate.onnx"))
    write(tmp_path / "touches.npz", simulate_touches(40, seed=42, instrument=instrument, margin_mm=MARGIN_MM))
    medians = []
    for _ in range(2):
        done = CliRunner().invoke(command, [str(path), str(tmp_path / "touches.npz"), "--json"])
        assert done.exception is None, done.output
        medians.append(json.loads(done.output)["median_mm"])
        save_atlas(atlas, atlas_path(path))
    assert medians[1] < 0.2 * medians[0]
