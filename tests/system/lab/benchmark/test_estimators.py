"""Estimators get what the daemon would give them: features of the residual, or the samples with the untouched plate."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import onnx
import pytest
import torch

from touchd.frame import Acquisition, Plate
from touchd.lab.benchmark.estimators import cost_of, network
from touchd.lab.benchmark.loop import BareNetwork, write_bare
from touchd.lab.benchmark.scenes import Block
from touchd.localization.features import Domain
from touchd.localization.model import Description, Model, default_model_path
from touchd.localization.model_file import put_model
from touchd.training.network.export import make_graph
from touchd.training.network.network import PaperNetwork

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
Kind = Literal["residual", "signal"]
SIZES: dict[Domain, int] = {"frequency": 392, "time": 1000}


def made(domain: Domain, kind: Kind, path: Path) -> Model:
    torch.manual_seed(1)
    untrained = PaperNetwork(SIZES[domain], (200.0, 150.0))
    untrained(torch.randn(64, SIZES[domain]) * 50)
    untrained.eval()
    about = Description(
        name="test", head="regression", domain=domain, input=kind, acquisition=RIG,
        plate=Plate(width_mm=200, height_mm=150), scores={"rmse_mm": 1.0},
    )  # fmt: skip
    return put_model(make_graph(untrained, about).SerializeToString(), path)


@pytest.mark.parametrize("kind", ["residual", "signal"])
@pytest.mark.parametrize("domain", ["frequency", "time"])
def test_a_network_sees_what_it_was_trained_on(domain: Domain, kind: Kind, tmp_path: Path) -> None:
    model = made(domain, kind, tmp_path / "model.onnx")
    estimator = network(model, "test")
    rng = np.random.default_rng(0)
    baseline, residual = rng.normal(0, 50, (2, *RIG.shape)).astype(np.float32)
    nothing = np.zeros((0, *RIG.shape), np.float32)
    estimator.rebase(Block(baseline, nothing, nothing, nothing, []))
    seen = residual + baseline if kind == "signal" else residual
    spectrum = np.fft.rfft(seen.astype(float) * np.hanning(250))[:, 51:100]
    bins = np.stack([spectrum.real, spectrum.imag], axis=1)
    model.features[:] = (bins if domain == "frequency" else seen).reshape(1, -1)
    wanted = model.estimate()[:2]
    model.features[:] = 0
    place = estimator.locate(residual)
    assert place is not None
    assert place == pytest.approx(wanted, abs=1e-2)
    transform = 4 * 250 * 98 if domain == "frequency" else 0
    weights = sum(a * b for a, b in ((SIZES[domain], 400), (400, 300), (300, 200), (200, 100), (100, 2)))
    assert estimator.macs == transform + weights


def test_the_bare_network_has_the_multiply_adds_of_the_paper_s(tmp_path: Path) -> None:
    path = write_bare(tmp_path / "bare.onnx")
    assert cost_of(onnx.load(path)) == (357_000, 4 * (357_000 + 400 + 300 + 200 + 100 + 2))
    bare = BareNetwork(path)
    bare()
    assert bare.position_mm.shape == (1, 2)
    assert np.isfinite(bare.position_mm).all()
    assert (bare.position_mm != 0).all()


@pytest.mark.parametrize("name", ["regression", "small", "grid10"])
def test_multiply_adds_are_those_of_the_weights_that_rows_are_multiplied_with(name: str) -> None:
    graph = onnx.load(default_model_path().with_name(f"{name}.onnx"))
    weights = sum(int(np.prod(t.dims)) for t in graph.graph.initializer if len(t.dims) == 2)
    assert cost_of(graph)[0] == weights


def test_an_int8_network_has_the_multiply_adds_of_the_original_and_far_fewer_bytes() -> None:
    whole, small = (onnx.load(default_model_path().with_name(name)) for name in ("regression.onnx", "int8.onnx"))
    assert cost_of(small)[0] == cost_of(whole)[0]
    assert cost_of(small)[1] < 0.3 * cost_of(whole)[1]
