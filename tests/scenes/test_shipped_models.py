"""The shipped models keep what their cards say, on touches that nobody trained with."""

from __future__ import annotations

import pytest

from touchd.evaluation.dataset import Dataset, make_dataset
from touchd.evaluation.model_scores import judge, scores
from touchd.localization.model import Model, default_model_path
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

MODELS = default_model_path().parent
TOUCHES = 800


@pytest.fixture(scope="module")
def silicone(instrument: Instrument) -> Dataset:
    return make_dataset(simulate_touches(TOUCHES, seed=20_261, instrument=instrument))


@pytest.fixture(scope="module")
def human(instrument: Instrument) -> Dataset:
    return make_dataset(simulate_touches(TOUCHES, seed=20_262, finger="human", instrument=instrument))


@pytest.fixture(scope="module")
def noisy(instrument: Instrument) -> Dataset:
    electronics = Electronics(noise_db=40.0)
    return make_dataset(simulate_touches(400, seed=20_264, instrument=instrument, electronics=electronics))


@pytest.fixture(scope="module")
def stale(instrument: Instrument) -> Dataset:
    return make_dataset(simulate_touches(TOUCHES, seed=20_263, stale_k=1.0, instrument=instrument))


def scored(name: str, data: Dataset) -> dict[str, float]:
    found = scores(judge(Model(MODELS / f"{name}.onnx"), data.residual, data.position_mm, data.noise_energy))
    print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in found.items()))
    return found


@pytest.mark.parametrize(("name", "most_mm"), [("regression", 0.7), ("int8", 0.7), ("small", 2.5)])
def test_fresh_touches_are_placed_as_the_cards_say(name: str, most_mm: float, silicone: Dataset) -> None:
    found = scored(name, silicone)
    assert found["mean_mm"] <= most_mm
    assert found["confident"] > 0.98


def test_the_papers_network_on_samples_does_as_its_card_says(instrument: Instrument) -> None:
    """It sees the signal itself, plate and all."""
    data = make_dataset(simulate_touches(TOUCHES, seed=20_261, instrument=instrument), "time")
    found = scores(judge(Model(MODELS / "time.onnx"), data.signal, data.position_mm, data.noise_energy))
    assert 5.0 < found["mean_mm"] <= 9.0


@pytest.mark.parametrize(("kind", "most_mm"), [("human", 1.1), ("stale", 1.5)])
def test_neither_another_finger_nor_a_stale_baseline_spoils_them(
    kind: str, most_mm: float, request: pytest.FixtureRequest
) -> None:
    assert scored("regression", request.getfixturevalue(kind))["mean_mm"] <= most_mm


@pytest.mark.parametrize("kind", ["silicone", "human", "noisy"])
@pytest.mark.parametrize("name", ["regression", "int8", "small"])
def test_68_percent_of_the_errors_are_within_sigma_in_any_noise_and_for_any_finger(
    name: str, kind: str, request: pytest.FixtureRequest
) -> None:
    """At 60 dB and at 40: within 5 points of it, and 3 for the chance of so few touches."""
    assert scored(name, request.getfixturevalue(kind))["within_sigma"] == pytest.approx(0.683, abs=0.08)


@pytest.mark.parametrize(("name", "least"), [("grid10", 0.97), ("keypad", 0.985)])
def test_zones_and_keys_are_the_right_ones(name: str, least: float, silicone: Dataset) -> None:
    """What is left of errors lies within a fraction of a millimetre of a border."""
    found = scored(name, silicone)
    assert found["accuracy"] >= least
    assert found.get("key_to_key_errors", 0) == 0


def test_all_know_where_they_come_from_and_are_small_enough_to_ship() -> None:
    paths = sorted(MODELS.glob("*.onnx"))
    assert {path.stem for path in paths} == {"regression", "small", "int8", "grid10", "keypad", "time"}
    assert sum(path.stat().st_size for path in paths) < 10e6
    one = Model(default_model_path()).description
    for path in paths:
        d = Model(path).description
        assert d.command.startswith("touchd train touches.npz -o "), path
        assert (d.data_sha256, d.scores["n"], d.plate, d.acquisition) == (
            one.data_sha256, 640, one.plate, one.acquisition
        )  # fmt: skip
        assert f"## {path.name}" in (MODELS / "README.md").read_text()
