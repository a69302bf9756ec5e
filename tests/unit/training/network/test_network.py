"""The network's target histograms, and a training from end to end on a handful of touches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from touchd.errors import TrainingError
from touchd.evaluation.dataset import Dataset, digest
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.training.network.network import PositionNetwork
from touchd.training.network.objectives import SPREAD_BINS
from touchd.training.train_network import Result, train

NETWORK = PositionNetwork(8, (200.0, 100.0), (4,))
HALF = st.floats(-0.5, 0.5, width=32)


@given(st.lists(st.tuples(HALF, HALF), min_size=1, max_size=20))
def test_a_target_histogram_sums_to_one_and_its_mean_is_the_position(places: list[tuple[float, float]]) -> None:
    position = torch.tensor(places)
    histogram = NETWORK.targets(position, SPREAD_BINS)
    assert histogram.shape == (len(places), 2, NETWORK.bins)
    assert (histogram >= 0).all()
    np.testing.assert_allclose(histogram.sum(dim=2), 1, atol=1e-5)
    mean = (histogram * NETWORK.centres).sum(dim=2)
    # Away from the histogram's ends, which lie a bin and a half beyond the plate's edge.
    inside = position.abs() < 0.5 - 1.5 / NETWORK.bins
    np.testing.assert_allclose(mean[inside], position[inside], atol=1e-3)
    np.testing.assert_allclose(mean, position, atol=5e-3)


@given(st.lists(st.tuples(HALF, HALF), min_size=1, max_size=20))
def test_the_network_says_a_place_as_its_histogram_means_it(places: list[tuple[float, float]]) -> None:
    position = torch.tensor(places)
    votes = NETWORK.targets(position, SPREAD_BINS).clamp_min(1e-30).log()
    position_mm = NETWORK.position_mm(votes)
    expected_mm = (position + 0.5) * torch.tensor([200.0, 100.0])
    np.testing.assert_allclose(position_mm, expected_mm, atol=1.0)


@given(st.integers(0, 1000))
def test_no_place_lies_outside_the_plate_and_every_sigma_is_positive(seed: int) -> None:
    features = 1e3 * torch.randn((16, 8), generator=torch.Generator().manual_seed(seed))
    position_mm, sigma_mm, confidence, noise_mm = NETWORK.eval()(features)
    assert ((position_mm >= 0) & (position_mm <= torch.tensor([200.0, 100.0]))).all()
    assert (sigma_mm > 0).all()
    assert (noise_mm > 0).all()
    assert ((confidence >= 0) & (confidence <= 1)).all()


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0, 10)), min_size=1, max_size=20))
def test_the_standard_error_is_the_root_of_the_sum_of_both_squares(rows: list[tuple[float, float, float]]) -> None:
    sigma, noise, ratio = np.array(rows).T
    logs = torch.from_numpy(np.stack([sigma, noise], axis=1))
    found = NETWORK.log_sigma(logs, torch.from_numpy(ratio)[:, None]).numpy()[:, 0]
    np.testing.assert_allclose(np.exp(found), np.hypot(np.exp(sigma), ratio * np.exp(noise)), rtol=1e-9)


@pytest.fixture(scope="module")
def few(touches: Recording) -> Recording:
    cut = {name: getattr(touches, name)[:600] for name in ("frames", "sequence", "timestamp_ns", "contacts_mm")}
    return replace(touches, **cut, force_n=None, temperature_c=None)


@pytest.fixture(scope="module")
def trained(few: Recording, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return train(few, tmp_path_factory.mktemp("model") / "a.onnx", seed=4, epochs=2, command="as a test")


def test_what_is_trained_is_written_as_a_model_that_knows_where_it_comes_from(trained: Result, few: Recording) -> None:
    loaded = Model(trained.model.path)
    loaded.check(few.acquisition)
    about = loaded.description
    assert (about.head, about.domain, about.input, about.seed) == ("regression", "frequency", "residual", 4)
    assert (about.data_sha256, about.command, about.plate) == (digest(few), "as a test", few.meta.plate)
    assert about.scores["n"] == trained.scores["n"] == 30
    assert len(trained.curve_mm) == 2
    assert sorted(path.name for path in trained.model.path.parent.iterdir()) == ["a.onnx"], "and nothing else"


def test_the_same_seed_gives_the_same_model(trained: Result, few: Recording, dataset: Dataset, tmp_path: Path) -> None:
    again = train(few, tmp_path / "a.onnx", seed=4, epochs=2, command="as a test")
    assert again.scores == trained.scores
    for one, two in zip(
        trained.model.run(dataset.residual).values(), again.model.run(dataset.residual).values(), strict=True
    ):
        np.testing.assert_array_equal(one, two)
    assert again.model.path.read_bytes() == trained.model.path.read_bytes()


def test_another_seed_gives_another_model(trained: Result, few: Recording, dataset: Dataset, tmp_path: Path) -> None:
    other = train(few, tmp_path / "a.onnx", seed=5, epochs=1)
    one, two = (m.run(dataset.residual)["position_mm"] for m in (trained.model, other.model))
    assert not np.array_equal(one, two)


def test_progress_counts_up_to_the_end(few: Recording, tmp_path: Path) -> None:
    predictions: list[tuple[str, int, int]] = []
    train(
        few,
        tmp_path / "a.onnx",
        epochs=1,
        progress=lambda what, done, steps, _rmse_mm: predictions.append((what, done, steps)),
    )
    for what in ("field", "network"):
        done = [(at, steps) for said, at, steps in predictions if said == what]
        assert [at for at, _ in done] == list(range(1, done[0][1] + 1))


def test_what_cannot_be_learned_from_leaves_no_file(few: Recording, tmp_path: Path) -> None:
    with pytest.raises(TrainingError):
        train(replace(few, contacts_mm=None), tmp_path / "a.onnx")
    assert list(tmp_path.iterdir()) == []
