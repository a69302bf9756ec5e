"""`touchd calibrate`: from an untouched plate and PLATE.toml to a model that finds touches."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import touchd
from touchd.calibration import calibrate
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.plate_fit import PlateFit, Progress, fit_plate
from touchd.calibration.untouched import Untouched
from touchd.errors import (
    CalibrationError,
    OutputError,
    PlateFileInvalid,
    PlateMismatch,
    PlatePoor,
    PlateTouched,
    PlateUnsteady,
    RecordingMissing,
    SignalClipped,
    TouchdError,
)
from touchd.frame import Chirp, Plate
from touchd.localization.model import Model
from touchd.localization.model_file import previous_path
from touchd.recording.data import Recording
from touchd.recording.format import write
from touchd.twin.instrument import Instrument
from touchd.twin.physics.transducer import Layout
from touchd.twin.simulate import simulate_scene, simulate_touches

SAID = """
[plate]
width_mm = 110.2
height_mm = 89.9
thickness_mm = 5.01
material = "glass"

[discs]
diameter_mm = 6
emitter_mm = [20.4, 49.8]
receivers_mm = [[12.3, 11.8], [97.6, 18.4], [85.3, 77.7]]
"""
"""What a ruler says of the plate below: each length is off."""


@pytest.fixture(scope="module")
def small() -> Instrument:
    layout = Layout(emitter_mm=(20, 50), receivers_mm=((12, 12), (98, 18), (85, 78)))
    return Instrument(Plate(width_mm=110, height_mm=90, thickness_mm=5), layout=layout, loss=6e-3)


@pytest.fixture(scope="module")
def idle(small: Instrument) -> Recording:
    return simulate_scene("idle", instrument=small, seed=4, frames=100)


@pytest.fixture(scope="module")
def fits() -> list[PlateFit]:
    """The fit of `home`, once it is made."""
    return []


@pytest.fixture(scope="module")
def home(small: Instrument, idle: Recording, fits: list[PlateFit], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an untouched recording, PLATE.toml, touches, and the model that was made of the first two."""
    home = tmp_path_factory.mktemp("calibrate")
    write(home / "idle.npz", idle)
    write(home / "touches.npz", simulate_touches(60, instrument=small, seed=5, margin_mm=3.0))
    (home / "PLATE.toml").write_text(SAID)

    def fit(said: PlateFile, mean: Untouched, progress: Progress) -> PlateFit:
        fits.append(fit_plate(said, mean, progress))
        return fits[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrate, "fit_plate", fit)
        done = touchd("calibrate", "idle.npz", "-o", "plate.onnx", "--plate", "PLATE.toml", "--json", cwd=home)
    assert done.code == 0, done.err
    (home / "said.json").write_text(done.out)
    return home


def test_whole_way(home: Path) -> None:
    """Never touched, measured with a ruler: touches all over the plate, up to its edges, are found to 0.1 mm."""
    done = touchd("evaluate", "plate.onnx", "touches.npz", "--json", cwd=home)
    assert done.code == 0
    scores = json.loads(done.out)
    print({name: scores[name] for name in ("median_mm", "p95_mm", "max_mm")})
    assert scores["by_fingers"]["1"]["missed"] == 0
    assert scores["median_mm"] < 0.1
    assert scores["max_mm"] < 1.0


def test_json(home: Path) -> None:
    """Verdict, expected error, reasons and parameters: each with what was said, what fits, and its standard error."""
    said = json.loads((home / "said.json").read_text())
    assert said["verdict"] == "good"
    assert 0 < said["expected_mm"] < 0.5
    assert said["reasons"] == []
    found = {p["name"]: p for p in said["parameters"]}
    assert found["emitter x"]["said"] == 20.4
    assert abs(found["emitter x"]["fitted"] - 20.0) < 0.1
    assert 0 < found["emitter x"]["standard_error"] < 0.5


def test_report(home: Path) -> None:
    """Beside the model lies a page with response, residual, parameters and expected error."""
    page = (home / "plate.report" / "report.md").read_text()
    assert "# plate.onnx: good" in page
    assert "| thickness | mm | 5.01 |" in page
    for picture in ("response.png", "residual.png", "expected-error.png"):
        assert picture in page
        assert (home / "plate.report" / picture).read_bytes().startswith(b"\x89PNG")


def test_usable_as_others(home: Path) -> None:
    """Doctor takes the model as a trained one, and compares the plate with the reference beside it."""
    doctor = touchd(
        "doctor", "--replay", "idle.npz", "--seconds", "0.7", "--json", cwd=home,
        TOUCHD_MODEL__PATH=str(home / "plate.onnx"), TOUCHD_BUS__BIND=f'["ipc://{home}/bus"]',
    )  # fmt: skip
    checks = {check["check"]: check for check in json.loads(doctor.out)["checks"]}
    assert checks["model"]["level"] == "ok"
    assert checks["baseline"]["level"] == "ok"


def test_taps(home: Path, small: Instrument, tmp_path: Path) -> None:
    """A mirrored drawing is found out by taps, named, and set right in the model."""
    mirrored = SAID
    for x_mm in ("20.4", "12.3", "97.6", "85.3"):
        mirrored = mirrored.replace(f"[{x_mm},", f"[{110 - float(x_mm):.1f},")
    (tmp_path / "PLATE.toml").write_text(mirrored)
    write(tmp_path / "taps.npz", simulate_touches(12, instrument=small, seed=6, label_noise_mm=1.0, margin_mm=8.0))
    done = touchd(
        "calibrate", home / "idle.npz", "-o", "m.onnx", "--plate", "PLATE.toml", "--taps", "taps.npz", "--json",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.code == 0, done.err
    said = json.loads(done.out)
    assert said["taps"]["orientation"] == "mirrored left to right"
    assert 0.5 < said["taps"]["scatter_mm"] < 1.6
    assert said["undecided"] == []
    scores = touchd("evaluate", "m.onnx", home / "touches.npz", "--json", cwd=tmp_path)
    assert json.loads(scores.out)["median_mm"] < 0.15


@pytest.fixture
def poor(fits: list[PlateFit], monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the fit of the same recording and PLATE.toml as `home`'s come out poor."""
    (known,) = fits
    bad = replace(known, verdict="poor", reasons=("4 mm fits better: measure it again",))
    monkeypatch.setattr(calibrate, "fit_plate", lambda _said, _mean, _progress: bad)


@pytest.mark.usefixtures("home", "poor")
def test_poor(home: Path, tmp_path: Path) -> None:
    """A poor fit has a status of its own and its reasons, and writes no model unless forced; the old one is kept."""
    (tmp_path / "m.onnx").write_bytes((home / "plate.onnx").read_bytes())
    before = (tmp_path / "m.onnx").read_bytes()
    options = ("calibrate", home / "idle.npz", "-o", tmp_path / "m.onnx", "--plate", home / "PLATE.toml", "--json")
    done = touchd(*options)
    assert done.code == PlatePoor.exit_code
    assert "4 mm fits better" in done.err
    said = json.loads(done.out)
    assert (said["verdict"], said["model"]) == ("poor", None)
    assert (tmp_path / "m.onnx").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.onnx", "m.poor.report"]
    done = touchd(*options, "--force", "--no-report")
    assert done.code == PlatePoor.exit_code
    assert json.loads(done.out)["model"] == str(tmp_path / "m.onnx")
    assert Model(tmp_path / "m.onnx").atlas is not None
    assert previous_path(tmp_path / "m.onnx").read_bytes() == before


def clipped(idle: Recording) -> Recording:
    frames = np.clip(idle.frames.astype(int) * 20, -32768, 32767).astype(np.int16)
    return replace(idle, frames=frames)


def touched(idle: Recording) -> Recording:
    frames = idle.frames.copy()
    frames[40:] += (0.05 * idle.frames[40:, :, ::-1]).astype(np.int16)
    return replace(idle, frames=frames)


def drifting(idle: Recording) -> Recording:
    later = np.linspace(0, 0.03, len(idle.frames))[:, None, None]
    return replace(idle, frames=(idle.frames + later * idle.frames[:, :, ::-1]).astype(np.int16))


def other_plate(idle: Recording) -> Recording:
    return replace(idle, meta=idle.meta.model_copy(update={"plate": Plate(width_mm=300, height_mm=200)}))


def channel_less(idle: Recording) -> Recording:
    return replace(idle, meta=idle.meta.model_copy(update={"receivers_mm": None}), frames=idle.frames[:, :2])


HOSTILE: dict[str, tuple[Callable[[Recording], Recording] | None, str, type[TouchdError]]] = {
    "clipped": (clipped, SAID, SignalClipped),
    "a finger on it": (touched, SAID, PlateTouched),
    "drift": (drifting, SAID, PlateUnsteady),
    "another plate": (other_plate, SAID, PlateMismatch),
    "a channel less": (channel_less, SAID, PlateMismatch),
    "metres": (None, SAID.replace("[20.4, 49.8]", "[0.0204, 0.0498]"), PlateFileInvalid),
    "a thickness in metres": (None, SAID.replace("5.01", "0.005"), PlateFileInvalid),
    "a disc outside": (None, SAID.replace("97.6", "120.0"), PlateFileInvalid),
    "no TOML": (None, "[plate\n", PlateFileInvalid),
    "deep": (None, "a = " + "[" * 5000, PlateFileInvalid),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile(name: str, idle: Recording, tmp_path: Path) -> None:
    """What cannot be calibrated is refused with its own status and one line, before anything is written."""
    spoil, said, error = HOSTILE[name]
    write(tmp_path / "r.npz", spoil(idle) if spoil else idle)
    (tmp_path / "PLATE.toml").write_text(said)
    done = touchd("calibrate", "r.npz", "-o", "m.onnx", "--plate", "PLATE.toml", cwd=tmp_path)
    assert done.code == error.exit_code, done.err
    assert " -> " in done.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["PLATE.toml", "r.npz"]


def test_hostile_taps(idle: Recording, small: Instrument, tmp_path: Path) -> None:
    """Taps that tell nothing of this plate are refused before the fit, with a remedy for what is wrong with them."""
    taps = simulate_touches(12, instrument=small, seed=6, margin_mm=8.0)
    meta, labels = taps.meta, taps.contacts_mm
    assert labels is not None
    hostile = {
        "touchd record --label": replace(taps, contacts_mm=None),
        "no untouched frame": cut(taps, np.flatnonzero(np.isfinite(labels[:, 0, 0]))),
        "correct the positions": replace(taps, contacts_mm=labels + np.float32(60)),
        "samples is 200, but": replace(taps, frames=taps.frames[:, :, :200].copy()),
        "sample_rate_hz is": replace(taps, meta=meta.model_copy(update={"sample_rate_hz": 1.5 * meta.sample_rate_hz})),
        "chirp is": replace(taps, meta=meta.model_copy(update={"chirp": Chirp(start_hz=30e3)})),
        "width_mm is 300": other_plate(taps),
    }
    write(tmp_path / "r.npz", idle)
    (tmp_path / "PLATE.toml").write_text(SAID)
    for problem, recording in hostile.items():
        write(tmp_path / "taps.npz", recording)
        done = touchd("calibrate", "r.npz", "-o", "m.onnx", "--plate", "PLATE.toml", "--taps", "taps.npz", cwd=tmp_path)
        assert done.code in (CalibrationError.exit_code, PlateMismatch.exit_code), problem
        assert problem in done.err
        assert "--taps: " in done.err
        assert "100/100" not in done.err, "the plate was fitted first"
    assert not (tmp_path / "m.onnx").exists()


def cut(recording: Recording, frames: np.ndarray) -> Recording:
    """Return these frames of a recording with their labels."""
    assert recording.contacts_mm is not None
    return Recording(
        recording.meta, recording.frames[frames], recording.sequence[frames], recording.timestamp_ns[frames],
        recording.contacts_mm[frames],
    )  # fmt: skip


@pytest.mark.parametrize("option", [("--seconds", "5"), ("--config", "touchd.toml")])
def test_an_option_that_a_recording_leaves_idle(option: tuple[str, str], idle: Recording, tmp_path: Path) -> None:
    """An option that says how to take frames is refused beside frames that are there, and not ignored."""
    write(tmp_path / "r.npz", idle)
    (tmp_path / "PLATE.toml").write_text(SAID)
    done = touchd("calibrate", "r.npz", "-o", "m.onnx", "--plate", "PLATE.toml", *option, cwd=tmp_path)
    assert done.code == 2
    assert f"no effect on a RECORDING: {option[0]}" in done.err


def test_names(idle: Recording, tmp_path: Path) -> None:
    """A model's name, its folder and the recording are checked first."""
    write(tmp_path / "r.npz", idle)
    (tmp_path / "PLATE.toml").write_text(SAID)
    for arguments, error in (
        (("r.npz", "-o", "m.bin"), OutputError), (("r.npz", "-o", "no/m.onnx"), OutputError),
        (("none.npz", "-o", "m.onnx"), RecordingMissing),
    ):  # fmt: skip
        done = touchd("calibrate", *arguments, "--plate", "PLATE.toml", cwd=tmp_path)
        assert done.code == error.exit_code, done.err
