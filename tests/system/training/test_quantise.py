"""The integer version of a model: what it is made from, and what it says of itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from touchd.cli.quantise import command
from touchd.errors import TrainingError
from touchd.evaluation.dataset import make_dataset, split
from touchd.evaluation.model_scores import judge
from touchd.localization.model import Model
from touchd.recording import format as recording
from touchd.recording.data import Recording
from touchd.training.network.export import quantise
from touchd.training.network.recipe import RECIPES
from touchd.training.train_network import train


@pytest.fixture(scope="module")
def original(touches: Recording, tmp_path_factory: pytest.TempPathFactory) -> Model:
    path = tmp_path_factory.mktemp("model") / "a.onnx"
    return train(touches, path, RECIPES["paper-regression"], epochs=20).model


def test_it_places_touches_as_the_original_does_in_less_than_half_the_size(
    original: Model, touches: Recording, tmp_path: Path
) -> None:
    made = quantise(original, touches, tmp_path / "b.onnx")
    assert made.path.stat().st_size < original.path.stat().st_size / 2
    data = make_dataset(touches)
    test = split(len(data), original.description.seed).test
    one, two = (model.run(data.signal[test])["position_mm"] for model in (original, made))
    apart_mm = np.linalg.norm(one - two, axis=1)
    error_mm = np.linalg.norm(one - data.position_mm[test], axis=1)
    print(
        f"integer version {apart_mm.mean():.3f} mm from the original, which is {error_mm.mean():.3f} mm from the truth"
    )
    assert 0 < apart_mm.mean() < error_mm.mean() / 2
    stated = made.description
    assert (stated.precision, original.description.precision) == ("int8", "float32")
    assert stated.scores["mean_mm"] == pytest.approx(
        np.linalg.norm(two - data.position_mm[test], axis=1).mean(), abs=1e-3
    )
    assert stated.model_copy(update={"precision": "float32", "scores": {}}) == original.description.model_copy(
        update={"scores": {}}
    )


def test_it_is_less_sure_by_as_much_as_it_errs_more(touches: Recording, tmp_path: Path) -> None:
    """On the touches of the validation part just as many of its errors are within sigma as of the original's."""
    original = train(touches, tmp_path / "a.onnx", RECIPES["best"], epochs=2).model
    made = quantise(original, touches, tmp_path / "b.onnx")
    data = make_dataset(touches)
    part = split(len(data), original.description.seed).validation
    one, two = (
        judge(model, data.residual[part], data.position_mm[part], data.noise_energy) for model in (original, made)
    )
    errors = [np.quantile(np.abs(said.error_mm) / said.sigma_mm[:, None], 0.6827) for said in (one, two)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)
    assert not np.allclose(one.sigma_mm, two.sigma_mm, rtol=1e-4)


def test_another_recording_and_an_integer_model_are_refused(
    original: Model, touches: Recording, tmp_path: Path
) -> None:
    frames = touches.frames.copy()
    frames[0, 0, 0] += 1
    with pytest.raises(TrainingError, match="trained on another recording"):
        quantise(original, replace(touches, frames=frames), tmp_path / "b.onnx")
    made = quantise(original, touches, tmp_path / "b.onnx")
    with pytest.raises(TrainingError, match="int8 already"):
        quantise(made, touches, tmp_path / "c.onnx")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.onnx"]


def test_the_verb_shows_what_it_costs(original: Model, touches: Recording, tmp_path: Path) -> None:
    recording.write(tmp_path / "touches.npz", touches)
    arguments = [str(original.path), str(tmp_path / "touches.npz"), "-o", str(tmp_path / "b.onnx")]
    result = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "rmse_mm" in result.output
    assert "->" in result.output
