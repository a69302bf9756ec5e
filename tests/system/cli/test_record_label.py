"""`touchd record --label`, played by a hand of the twin that does what is asked."""

from __future__ import annotations

import stat
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import touchd
from tests.unit.calibration.plates import LAYOUT, PLATE, exact_fit
from touchd.calibration.check import check_model
from touchd.calibration.physical_atlas import make_physical_atlas
from touchd.calibration.plate_file import check_plate_file
from touchd.calibration.start_scan import start_scan
from touchd.calibration.taps import orientation_of, refine, taps_of
from touchd.calibration.untouched import untouched_acts, untouched_mean
from touchd.calibration.walk import UNTOUCHED_S, plan
from touchd.localization.atlas import Atlas, atlas_path, save_atlas
from touchd.localization.model import Description
from touchd.localization.model_file import put_model
from touchd.recording.data import Recording
from touchd.recording.format import read, write
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.scenes.timeline import Stage, line, still
from touchd.twin.simulate import simulate_stage

RATE_HZ = 125.0
LONG_S = {"tap": 0.2, "thumb": 0.2, "stroke": 1.2, "palm": 1.2}
PAUSE_S = 0.8
ERROR_MM = 1.0
"""Of the hand, per axis."""
KINDS = {"tap": "human", "stroke": "human", "thumb": "thumb", "palm": "palm"}


def stage() -> Stage:
    """What a hand does that follows the plan."""
    tasks = plan(PLATE)
    seconds = UNTOUCHED_S + 1 + sum(LONG_S[task.name] + PAUSE_S for task in tasks[1:])
    n = round(seconds * RATE_HZ)
    rng = np.random.default_rng(5)
    made = Stage(PLATE, RATE_HZ, np.arange(n), np.full(n, REFERENCE_C), rng, Electronics())
    at_s = UNTOUCHED_S + 1
    for task in tasks[1:]:
        ends = np.clip(np.array(task.places_mm) + ERROR_MM * rng.standard_normal(2), 6, None)
        long_s = LONG_S[task.name]
        path = line(ends[0], ends[1], long_s) if len(ends) == 2 else still(*ends[0])
        path = still(PLATE.width_mm / 2, PLATE.height_mm / 2) if task.name == "palm" else path  # it has no room beside
        area_mm2 = 90.0 if task.name == "palm" else None
        made.lay(KINDS[task.name], at_s, at_s + long_s, path, force_n=0.5, area_mm2=area_mm2)
        at_s += long_s + PAUSE_S
    return made


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The recording that the command made of the hand's frames, and what it said."""
    folder = tmp_path_factory.mktemp("label")
    hand = simulate_stage(stage(), Instrument(PLATE, layout=LAYOUT), 3)
    write(folder / "hand.npz", Recording(hand.meta, hand.frames, hand.sequence, hand.timestamp_ns), compress=False)
    done = touchd("record", "--label", "--replay", folder / "hand.npz", "--speed", "max", "-o", folder / "plate.npz")
    assert done.code == 0, done.err
    return folder / "plate.npz", done.out


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    fit = exact_fit(Instrument(PLATE, layout=LAYOUT))
    return make_physical_atlas(fit, 1e-3 * float(np.sqrt(np.square(fit.measured).mean())))


def test_every_act(walked: tuple[Path, str]) -> None:
    """Each act is found in its order, the person is told each place, and the list at the end is ticked."""
    path, said = walked
    found, tasks = read(path), plan(PLATE)
    assert [(act.name, act.places_mm) for act in found.meta.acts] == [(task.name, task.places_mm) for task in tasks]
    assert all(task.text in said for task in tasks)
    assert said.count("[x]") == 5
    assert "PLATE.toml" in said
    assert found.meta.acts[-1].end == len(found.frames)


def test_private(walked: tuple[Path, str]) -> None:
    """The file tells no serial number, and only its owner may read it."""
    path, _ = walked
    assert read(path).meta.device.serial == ""
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_calibrates(walked: tuple[Path, str]) -> None:
    """`calibrate` takes the untouched act of it, ten seconds of which it leaves nothing out."""
    said = check_plate_file({
        "plate": {**PLATE.model_dump(include={"width_mm", "height_mm", "thickness_mm"}), "material": "glass"},
        "discs": {"diameter_mm": 6, "emitter_mm": LAYOUT.emitter_mm, "receivers_mm": LAYOUT.receivers_mm},
    })  # fmt: skip
    untouched = untouched_mean(untouched_acts(read(walked[0])), said)
    assert untouched.frames > 0.95 * UNTOUCHED_S * RATE_HZ


def test_taps(walked: tuple[Path, str], atlas: Atlas) -> None:
    """`calibrate --taps` takes the taps alone: they tell the drawing's orientation, and how well the hand hit."""
    taps = taps_of(read(walked[0]), atlas)
    assert len(taps.label_mm) == sum(task.name == "tap" for task in plan(PLATE))
    assert orientation_of(atlas, taps) == 0
    refined = refine(atlas, taps)
    assert refined.used == refined.taps
    assert refined.scatter_mm == pytest.approx(ERROR_MM, rel=0.5)


def test_check(walked: tuple[Path, str], atlas: Atlas, tmp_path: Path) -> None:
    """`check` finds all of its touches but the palms, and a right model is good."""
    d = atlas.description
    description = Description(
        name="right", head="regression", domain="frequency", input="residual", acquisition=d.acquisition,
        plate=d.plate, taper=d.taper,
    )  # fmt: skip
    path = tmp_path / "right.onnx"
    save_atlas(atlas, atlas_path(path))
    put_model(start_scan(atlas, description).SerializeToString(), path)
    checked = check_model(path, walked[0])
    assert checked.verdict == "good", checked
    assert checked.touches >= sum(task.name != "palm" for task in plan(PLATE)) - 1
