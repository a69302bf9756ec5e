"""A training from end to end on some hundred touches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchd.errors import TrainingError
from touchd.evaluation.dataset import Dataset, digest
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.training.train_network import Result, train


@pytest.fixture(scope="module")
def told() -> list[tuple[str, int, int]]:
    """What a training says of its progress: the stage, steps done, and steps in all."""
    return []


@pytest.fixture(scope="module")
def trained(touches: Recording, told: list[tuple[str, int, int]], tmp_path_factory: pytest.TempPathFactory) -> Result:
    return train(
        touches, tmp_path_factory.mktemp("model") / "a.onnx", seed=4, epochs=2, command="as a test",
        progress=lambda what, done, steps, _rmse_mm: told.append((what, done, steps)),
    )  # fmt: skip


def test_origin(trained: Result, touches: Recording) -> None:
    """The model says what it was trained on, with which seed and command."""
    loaded = Model(trained.model.path)
    loaded.check(touches.acquisition)
    about = loaded.description
    assert (about.head, about.domain, about.input, about.seed) == ("regression", "frequency", "residual", 4)
    assert (about.data_sha256, about.command, about.plate) == (digest(touches), "as a test", touches.meta.plate)
    assert about.scores["n"] == trained.scores["n"] == 40
    assert len(trained.curve.validation_mm) == 2
    assert sorted(path.name for path in trained.model.path.parent.iterdir()) == ["a.onnx"], "and nothing else"


def test_same_seed(trained: Result, touches: Recording, dataset: Dataset, tmp_path: Path) -> None:
    """The same seed gives the same model, to the byte."""
    again = train(touches, tmp_path / "a.onnx", seed=4, epochs=2, command="as a test")
    assert again.scores == trained.scores
    for one, two in zip(
        trained.model.run(dataset.residual).values(), again.model.run(dataset.residual).values(), strict=True
    ):
        np.testing.assert_array_equal(one, two)
    assert again.model.path.read_bytes() == trained.model.path.read_bytes()


def test_another_seed(trained: Result, touches: Recording, dataset: Dataset, tmp_path: Path) -> None:
    """Another seed gives another model."""
    other = train(touches, tmp_path / "a.onnx", seed=5, epochs=1)
    one, two = (m.run(dataset.residual)["position_mm"] for m in (trained.model, other.model))
    assert not np.array_equal(one, two)


@pytest.mark.usefixtures("trained")
def test_progress(told: list[tuple[str, int, int]]) -> None:
    """Progress counts up to the end."""
    for what in ("field", "network"):
        done = [(at, steps) for said, at, steps in told if said == what]
        assert [at for at, _ in done] == list(range(1, done[0][1] + 1))


def test_no_truth(touches: Recording, tmp_path: Path) -> None:
    """A recording without truth leaves no file."""
    with pytest.raises(TrainingError):
        train(replace(touches, contacts_mm=None), tmp_path / "a.onnx")
    assert list(tmp_path.iterdir()) == []
