"""`touchd train` and `touchd evaluate`, as they are typed: on plates that nobody here has seen, and on wrong ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from click.testing import CliRunner

from touchd.cli import evaluate
from touchd.cli import train as train_verb
from touchd.errors import ModelMismatch, OutputError, TouchdError, TrainingError
from touchd.frame import Acquisition, Chirp, Plate
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.recording.format import read, write
from touchd.twin.instrument import Instrument
from touchd.twin.physics.transducer import Layout
from touchd.twin.simulate import simulate_touches

COUNT = 110


def made(plate: Plate, layout: Layout, acquisition: Acquisition) -> Recording:
    return simulate_touches(COUNT, seed=7, instrument=Instrument(plate, layout=layout, acquisition=acquisition))


class Trained(NamedTuple):
    recording: Path
    model: Path
    printed: str


def said(*arguments: object) -> str:
    """What a verb prints; a failure is raised."""
    verb = {"train": train_verb.command, "evaluate": evaluate.command}[str(arguments[0])]
    done = CliRunner().invoke(verb, [str(argument) for argument in arguments[1:]], catch_exceptions=True)
    if done.exception is not None:
        raise done.exception
    return done.output


@pytest.fixture(scope="module")
def glass(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Small, oblong and thick, three receivers, 200 samples at 240 kHz, another chirp."""
    folder = tmp_path_factory.mktemp("glass")
    recording = made(
        Plate(width_mm=80, height_mm=120, thickness_mm=8),
        Layout(emitter_mm=(20.0, 60.0), receivers_mm=((12.0, 15.0), (68.0, 20.0), (60.0, 108.0))),
        Acquisition(
            channels=3, samples=200, sample_rate_hz=240e3, chirp=Chirp(start_hz=45e3, stop_hz=90e3, duration_s=0.5e-3)
        ),
    )
    write(folder / "glass.npz", recording)
    printed = said("train", folder / "glass.npz", "-o", folder / "glass.onnx", "--epochs", "1")
    return Trained(folder / "glass.npz", folder / "glass.onnx", printed)


def test_other_plate(glass: Trained) -> None:
    """A plate of another size, rate and number of channels is trained without options."""
    about = Model(glass.model).description
    assert about.acquisition.shape == (3, 200)
    assert (about.plate.width_mm, about.plate.height_mm, about.acquisition.sample_rate_hz) == (80, 120, 240e3)
    assert about.inputs == 3 * 2 * 37
    assert about.command == "touchd train glass.npz -o glass.onnx --recipe best --seed 0 --epochs 1"
    assert "on 11 touches never seen in training" in glass.printed


def test_warning(glass: Trained) -> None:
    """A warning is printed and in the report."""
    few = "77 training touches are fewer than"
    assert f"touchd: warning: {few}" in glass.printed
    assert few in (glass.model.with_suffix(".report") / "report.md").read_text()


def test_evaluated(glass: Trained, tmp_path: Path) -> None:
    """A model is evaluated on a recording of its plate."""
    picture = tmp_path / "errors.png"
    found = json.loads(said("evaluate", glass.model, glass.recording, "--json", "--plot", picture))
    assert found["n"] == COUNT
    assert set(found) >= {"rmse_mm", "mean_mm", "sd_mm", "median_mm", "p95_mm", "max_mm"}
    assert 0 < found["median_mm"] < found["p95_mm"] <= found["max_mm"] < np.hypot(80, 120)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_aluminium(tmp_path: Path) -> None:
    """An aluminium plate with many receivers and keys is trained."""
    receivers = tuple((15.0 + 26 * i, 15.0 + 20 * (i % 3)) for i in range(6))
    recording = made(
        Plate(width_mm=160, height_mm=70, thickness_mm=6, material="aluminium"),
        Layout(emitter_mm=(80.0, 30.0), receivers_mm=receivers),
        Acquisition(
            channels=6, samples=128, sample_rate_hz=200e3, chirp=Chirp(start_hz=40e3, stop_hz=80e3, duration_s=0.6e-3)
        ),
    )
    keys = tmp_path / "keys.toml"
    keys.write_text("".join(
        f'[[key]]\nname = "{name}"\nx_mm = {8 + 50 * i}\ny_mm = 10\nwidth_mm = 45\nheight_mm = 50\n'
        for i, name in enumerate(("left", "middle", "right"))
    ))  # fmt: skip
    write(tmp_path / "a.npz", recording)
    model = tmp_path / "a.onnx"
    said(
        "train", tmp_path / "a.npz", "-o", model, "--recipe", "keypad", "--layout", keys, "--epochs", "1", "--no-report"
    )
    found = json.loads(said("evaluate", model, tmp_path / "a.npz", "--json"))
    assert 0 <= found["accuracy"] <= 1
    assert 0 <= found["key_to_key_errors"] <= COUNT
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "a.onnx", "keys.toml"]


def refused(error: type[TouchdError], *arguments: object) -> str:
    with pytest.raises(error) as caught:
        said(*arguments)
    return str(caught.value)


def test_other_shape(glass: Trained) -> None:
    """A model of another plate is refused with both shapes."""
    shipped = Path(__file__).parents[3] / "models" / "regression.onnx"
    text = refused(ModelMismatch, "evaluate", shipped, glass.recording)
    assert "(4, 250)" in text
    assert "(3, 200)" in text


def test_few_touches(glass: Trained, tmp_path: Path) -> None:
    """Ten touches are enough to judge a model by."""
    whole = read(glass.recording)
    cut = {name: getattr(whole, name)[:20] for name in ("frames", "sequence", "timestamp_ns", "contacts_mm")}
    write(tmp_path / "few.npz", replace(whole, **cut, force_n=None, faces=None, temperature_c=None))
    assert json.loads(said("evaluate", glass.model, tmp_path / "few.npz", "--json"))["n"] == 10


def test_other_size(glass: Trained, tmp_path: Path) -> None:
    """A model of a plate of another size is judged with a warning."""
    whole = read(glass.recording)
    plate = whole.meta.plate.model_copy(update={"width_mm": 81.0})
    write(tmp_path / "wider.npz", replace(whole, meta=whole.meta.model_copy(update={"plate": plate})))
    printed = said("evaluate", glass.model, tmp_path / "wider.npz")
    assert "warning: the model is for a plate of 80 x" in printed
    assert "of one of 81 x" in printed


def test_two_plates(glass: Trained, touches_file: Path, tmp_path: Path) -> None:
    """Recordings of two plates are not mixed."""
    text = refused(TrainingError, "train", glass.recording, touches_file, "-o", tmp_path / "a.onnx")
    assert "mixed acquisitions: channels is 3 in" in text
    assert "but 4 here" in text
    assert not (tmp_path / "a.onnx").exists()


@pytest.fixture(scope="module")
def touches_file(instrument: Instrument, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("touches") / "touches.npz"
    write(path, simulate_touches(COUNT, seed=7, instrument=instrument))
    return path


def test_two_recordings(glass: Trained, tmp_path: Path) -> None:
    """Two recordings of one plate are trained on together."""
    model = tmp_path / "a.onnx"
    arguments: list[Any] = ["--recipe", "paper-regression", "--epochs", "1", "--no-report"]
    printed = said("train", glass.recording, glass.recording, "-o", model, *arguments)
    assert "on 22 touches never seen in training" in printed
    assert "110 touches are exact copies" in printed
    assert "touchd train glass.npz glass.npz -o a.onnx" in Model(model).description.command


def test_no_folder(glass: Trained, tmp_path: Path) -> None:
    """A missing folder is reported before any training."""
    text = refused(OutputError, "train", glass.recording, "-o", tmp_path / "no" / "a.onnx")
    assert str(tmp_path / "no") in text


def test_old_report(glass: Trained, tmp_path: Path) -> None:
    """A replaced model does not keep the older one's report."""
    model, recipe = tmp_path / "a.onnx", ["--recipe", "paper-regression", "--epochs", "1", "--force"]
    said("train", glass.recording, "-o", model, *recipe)
    assert (tmp_path / "a.report").is_dir()
    said("train", glass.recording, "-o", model, *recipe, "--no-report")
    assert not (tmp_path / "a.report").exists()


def test_no_truth(glass: Trained, tmp_path: Path) -> None:
    """A recording without truth is refused."""
    bare = replace(read(glass.recording), contacts_mm=None, force_n=None)
    write(tmp_path / "bare.npz", bare)
    assert "contacts_mm" in refused(TrainingError, "train", tmp_path / "bare.npz", "-o", tmp_path / "a.onnx")
