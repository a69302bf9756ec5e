"""The report beside a model: a page and pictures, whole or not at all, that say what the model is worth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from touchd.errors import OutputError
from touchd.evaluation.model_scores import Judgement
from touchd.keypad import PHONE, load_layout
from touchd.recording.data import Recording
from touchd.training.network.recipe import RECIPES
from touchd.training.report.report import findings, report_folder, write_folder, write_report
from touchd.training.train_network import Result, train


@pytest.fixture(scope="module")
def result(few: Recording, tmp_path_factory: pytest.TempPathFactory) -> Result:
    path = tmp_path_factory.mktemp("report") / "plate.onnx"
    return train(few, path, RECIPES["paper-regression"], epochs=2, command="touchd train few.npz")


def is_picture(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000


def test_a_report_lies_beside_its_model_and_shows_every_picture_it_has(result: Result, few: Recording) -> None:
    folder = write_report(result, few.meta, ["few.npz"])
    assert folder == result.model.path.parent / "plate.report"
    text = (folder / "report.md").read_text()
    pictures = {path.name for path in folder.iterdir()} - {"report.md"}
    assert pictures == {"learning-curve.png", "error-map.png", "sigma.png"}
    assert all(is_picture(folder / name) and f"]({name})" in text for name in pictures)


def test_the_page_says_scores_warnings_and_where_the_model_comes_from(result: Result, few: Recording) -> None:
    text = (write_report(result, few.meta, ["few.npz"]) / "report.md").read_text()
    for name, value in result.scores.items():
        assert f"| `{name}` |" in text
        assert name == "n" or f"{value:.3f}" in text or f"{100 * value:.1f}" in text
    assert all(f"- {note}\n" in text for note in result.notes)
    assert len(result.notes) >= 1
    for words in ("`touchd train few.npz`", result.model.description.data_sha256, "140 touches for training", "seed 0"):
        assert words in text


@pytest.mark.parametrize(
    ("recipe", "picture"), [("paper-grid", "zones.png"), ("paper-keypad", "confusion.png")]
)  # fmt: skip
def test_a_classifier_has_a_picture_of_its_classes(recipe: str, picture: str, few: Recording, tmp_path: Path) -> None:
    trained = train(few, tmp_path / "a.onnx", RECIPES[recipe], grid=3, layout=load_layout(PHONE), epochs=1)
    assert is_picture(write_report(trained, few.meta, ["few.npz"]) / picture)


def test_replaced(tmp_path: Path) -> None:
    """A newer report takes the place of the older one whole."""
    folder = write_folder(tmp_path / "plate.onnx", {"old.png": Figure(), "both.png": Figure()}, "one")
    assert folder == report_folder(tmp_path / "plate.onnx")
    write_folder(tmp_path / "plate.onnx", {"both.png": Figure()}, "two")
    assert sorted(path.name for path in folder.iterdir()) == ["both.png", "report.md"]
    assert (folder / "report.md").read_text() == "two"
    assert list(tmp_path.iterdir()) == [folder], "and nothing else"


def test_unwritable(tmp_path: Path) -> None:
    """A report that cannot be written leaves the older one."""
    folder = write_folder(tmp_path / "plate.onnx", {"one.png": Figure()}, "one")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    class Full(Figure):
        def savefig(self, *_arguments: object, **_options: object) -> None:
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="No space left"):
        write_folder(tmp_path / "plate.onnx", {"two.png": Full()}, "two")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert list(tmp_path.iterdir()) == [folder]


def judged(error_mm: np.ndarray, sigma_mm: float) -> Judgement:
    true_mm = np.random.default_rng(1).uniform(0, 200, error_mm.shape).astype(np.float32)
    return Judgement(true_mm, true_mm + error_mm, np.full(len(true_mm), sigma_mm), np.ones(len(true_mm)))


@pytest.mark.parametrize(("sigma_mm", "says"), [(1.0, "about right: 68 %"), (3.0, "too large"), (0.3, "too small")])
def test_a_standard_error_is_called_what_it_is(sigma_mm: float, says: str, result: Result, few: Recording) -> None:
    said = judged(np.random.default_rng(2).standard_normal((20_000, 2)), sigma_mm)
    assert any(says in line for line in findings(replace(result, judged=said), few.meta.plate))


def test_a_model_that_is_worse_near_the_edges_is_told(result: Result, few: Recording) -> None:
    said = judged(np.random.default_rng(2).standard_normal((2_000, 2)), 1.0)
    assert any("Similar near the edges" in line for line in findings(replace(result, judged=said), few.meta.plate))
    near = ((said.true_mm < 15) | (said.true_mm > 185)).any(axis=1)
    worse = replace(said, position_mm=said.true_mm + said.error_mm * np.where(near, 3, 1)[:, None])
    assert any("Worse near the edges" in line for line in findings(replace(result, judged=worse), few.meta.plate))
