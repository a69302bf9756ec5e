"""The shipped model keeps what its card says, on touches that nobody trained with."""

import pytest

from touchd.evaluation.metrics import position_scores
from touchd.model import Model, default_model_path
from touchd.training.dataset import make_dataset
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches


@pytest.mark.parametrize("finger", ["silicone", "human"])
def test_a_fresh_session_is_placed_within_3_mm_rmse(finger: str, instrument: Instrument) -> None:
    margin_mm = 5.0 if finger == "silicone" else 6.0
    recording = simulate_touches(800, seed=20_261, finger=finger, margin_mm=margin_mm, instrument=instrument)
    data = make_dataset(recording)
    outputs = Model(default_model_path()).run(data.residual)
    scores = position_scores(outputs["position_mm"] - data.position_mm)
    print(f"{finger}: RMSE {scores['rmse_mm']:.2f}, median {scores['median_mm']:.2f}, max {scores['max_mm']:.1f} mm")
    assert scores["rmse_mm"] <= 3.0
    assert (outputs["confidence"] >= 0.5).mean() > 0.98


def test_the_model_says_where_it_comes_from() -> None:
    d = Model(default_model_path()).description
    assert d.command.startswith("touchd train touches.npz -o regression.onnx")
    assert len(d.data_sha256) == 64
    assert d.scores["rmse_mm"] <= 3.0
    assert d.scores["n"] == 640
