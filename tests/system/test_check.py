"""A model is judged on touches whose places nobody tells."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.unit.calibration.plates import LAYOUT, PLATE, exact_fit, model_of
from touchd.calibration.check import Checked, check_model
from touchd.cli.main import main
from touchd.errors import ModelMismatch, RecordingValues
from touchd.localization.model import default_model_path
from touchd.recording.format import read, write
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.scenes.timeline import Stage, still
from touchd.twin.simulate import simulate_scene, simulate_stage


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("check")
    instrument = Instrument(PLATE, layout=LAYOUT)
    fit = exact_fit(instrument)
    model_of(fit, folder / "right.onnx")
    emitter = (LAYOUT.emitter_mm[0] + 3.0, LAYOUT.emitter_mm[1])
    model_of(replace(fit, layout=LAYOUT.model_copy(update={"emitter_mm": emitter})), folder / "moved.onnx")
    write(folder / "use.npz", replace(
        simulate_scene("tap", instrument=instrument, frames=1500, seed=2), contacts_mm=None, force_n=None
    ))  # fmt: skip
    write(folder / "idle.npz", simulate_scene("idle", instrument=instrument, frames=300, seed=2))
    return folder


@pytest.fixture(scope="module")
def right(folder: Path) -> Checked:
    """What is said of the right model."""
    return check_model(folder / "right.onnx", folder / "use.npz")


def test_right_model(right: Checked) -> None:
    """A right model is good, and the estimated error is small."""
    checked = right
    assert checked.verdict == "good", checked
    assert checked.unexplained is not None
    assert checked.unexplained < 0.01
    assert checked.error_mm is not None
    assert checked.error_mm < 0.1


@pytest.mark.parametrize(("kind", "apart_mm"), [("fingertip", 0.3), ("thumb", 0.8)])
def test_wide_finger(folder: Path, kind: str, apart_mm: float) -> None:
    """Faces as wide as the waves, which give way to them, are no reason to doubt a right model."""
    n = 750
    made = Stage(PLATE, 125.0, np.arange(n), np.full(n, REFERENCE_C), np.random.default_rng(5), Electronics())
    for k, (x, y) in enumerate(made.rng.uniform([9, 9], [PLATE.width_mm - 9, PLATE.height_mm - 9], (10, 2))):
        made.lay(kind, 1 + 0.5 * k, 1.25 + 0.5 * k, still(float(x), float(y)), force_n=0.6)
    use = simulate_stage(made, Instrument(PLATE, layout=LAYOUT), 5)
    path = folder / f"{kind}.npz"
    write(path, replace(use, contacts_mm=None, force_n=None, faces=None))
    checked = check_model(folder / "right.onnx", path)
    assert checked.verdict == "good", checked
    assert checked.apart_mm is not None
    assert checked.apart_mm < apart_mm


def test_moved_disc(folder: Path) -> None:
    """A disc 3 mm off calls for another calibration, and the reason has its number."""
    checked = check_model(folder / "moved.onnx", folder / "use.npz")
    assert checked.verdict == "calibrate again", checked
    assert "%" in checked.reasons[0]


def test_dead_disc(folder: Path, right: Checked) -> None:
    """A disc that is not heard is named, though the others place touches."""
    use = read(folder / "use.npz")
    frames = use.frames.copy()
    frames[:, 1] = np.random.default_rng(1).integers(-2, 3, frames[:, 1].shape)
    write(folder / "dead.npz", replace(use, frames=frames))
    dead = check_model(folder / "right.onnx", folder / "dead.npz").reasons
    assert [reason for reason in dead if "dead" in reason] == ["receiver 2 is dead: check its disc and cable"]
    assert not right.reasons


def test_swapped_cables(folder: Path) -> None:
    """Where no finger is placed since cables were swapped, that is what is said, also of a recording with few touches.

    A minute of it once ended in an internal error, and a short one only asked for a minute.
    """
    use = read(folder / "use.npz")
    swapped = replace(use, frames=use.frames[:, [1, 0, 2]])
    write(folder / "swapped.npz", swapped)
    checked = check_model(folder / "right.onnx", folder / "swapped.npz")
    assert checked.verdict == "calibrate again"
    assert "cables were swapped" in checked.reasons[0]
    short = simulate_scene("tap", instrument=Instrument(PLATE, layout=LAYOUT), frames=500, seed=2)
    write(folder / "short.npz", replace(short, frames=short.frames[:, [1, 0, 2]]))
    with pytest.raises(RecordingValues, match=r"cables were swapped since; .*record a minute"):
        check_model(folder / "right.onnx", folder / "short.npz")


def test_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command line says the same, to a person and as JSON."""
    asked = ["check", str(folder / "right.onnx"), str(folder / "use.npz")]
    assert main(asked) == 0
    assert capsys.readouterr().out.startswith("good\n")
    assert main([*asked, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "good"


def test_no_touch(folder: Path) -> None:
    """A recording that nobody touches tells nothing, and what to record is said."""
    with pytest.raises(RecordingValues, match="record a minute"):
        check_model(folder / "right.onnx", folder / "idle.npz")


def test_other_acquisition(folder: Path) -> None:
    """A model of other frames is refused."""
    with pytest.raises(ModelMismatch):
        check_model(default_model_path(), folder / "use.npz")
