"""Every recipe trains, exports and loads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from touchd.errors import TrainingError
from touchd.evaluation.dataset import make_dataset
from touchd.evaluation.model_scores import judge, scores
from touchd.keypad import PHONE, load_layout
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.training.network.recipe import RECIPES
from touchd.training.train_network import train

LAYOUT = load_layout(PHONE)


@pytest.mark.parametrize("name", [name for name in RECIPES if name != "small"])
def test_model(name: str, touches: Recording, tmp_path: Path) -> None:
    """A recipe gives a model that says what it is, and carries the scores that it is given on its test touches."""
    recipe = RECIPES[name]
    result = train(touches, tmp_path / "a.onnx", recipe, grid=4, layout=LAYOUT, epochs=1)
    model = Model(tmp_path / "a.onnx")
    d = model.description
    assert (d.name, d.head, d.domain) == (name, recipe.head, recipe.domain)
    assert d.input == ("signal" if recipe.paper else "residual")
    data = make_dataset(touches, recipe.domain)
    features = data.signal if recipe.paper else data.residual
    model.features[0] = features[0]
    estimate = model.estimate()
    assert 0 <= estimate.x_mm <= 200
    assert 0 <= estimate.y_mm <= 200
    assert result.scores["n"] == 40
    test = result.parts.test
    found = scores(judge(model, features[test], data.position_mm[test], data.noise_energy))
    assert found == pytest.approx({name: d.scores[name] for name in found}, abs=1e-4)


def test_unknown_material(few: Recording, tmp_path: Path) -> None:
    """A plate of unknown material is trained, on few touches too, with a loud note."""
    meta = few.meta.model_copy(update={"plate": few.meta.plate.model_copy(update={"material": "unobtainium"})})
    result = train(replace(few, meta=meta), tmp_path / "a.onnx", epochs=1)
    assert sum("unobtainium" in note for note in result.notes) == 1


def test_no_classes(few: Recording, tmp_path: Path) -> None:
    """A grid of one zone and a keypad without keys are refused."""
    with pytest.raises(TrainingError, match="1 x 1"):
        train(few, tmp_path / "a.onnx", RECIPES["grid"], grid=1)
    with pytest.raises(TrainingError, match="keys"):
        train(few, tmp_path / "a.onnx", RECIPES["keypad"])
