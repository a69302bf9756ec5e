"""The networks that only the benchmark has compute what they are said to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchd.lab.benchmark import graphs
from touchd.lab.benchmark.boundnetwork import BoundNetwork
from touchd.localization.features import make_features
from touchd.localization.model import Model, default_model_path


def written(graph: onnx.ModelProto, folder: Path, rows: int = 1) -> BoundNetwork:
    path = folder / "network.onnx"
    path.write_bytes(graph.SerializeToString())
    return BoundNetwork(path, rows)


def test_the_bare_network_has_the_multiply_adds_of_the_paper_s(tmp_path: Path) -> None:
    graph = graphs.bare_network()
    assert graphs.multiply_adds(graph) == 357_000
    assert graphs.weight_bytes(graph) == 4 * (357_000 + 400 + 300 + 200 + 100 + 2)
    network = written(graph, tmp_path)
    network.inputs[...] = 1.0
    network()
    assert network.outputs["position_mm"].shape == (1, 2)
    assert np.isfinite(network.outputs["position_mm"]).all()


@pytest.mark.parametrize("name", ["regression", "small", "grid10"])
def test_multiply_adds_are_those_of_the_weights_that_rows_are_multiplied_with(name: str) -> None:
    graph = onnx.load(default_model_path().with_name(f"{name}.onnx"))
    weights = sum(int(np.prod(t.dims)) for t in graph.graph.initializer if len(t.dims) == 2)
    assert graphs.multiply_adds(graph) == weights


def test_an_int8_network_has_the_multiply_adds_of_the_original_and_far_fewer_bytes() -> None:
    whole, small = (onnx.load(default_model_path().with_name(name)) for name in ("regression.onnx", "int8.onnx"))
    assert graphs.multiply_adds(small) == graphs.multiply_adds(whole)
    assert graphs.weight_bytes(small) < 0.3 * graphs.weight_bytes(whole)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1.0, 300.0))
def test_features_inside_the_graph_and_float64_place_a_frame_where_the_daemon_does(seed: int, size: float) -> None:
    model, graph = Model(default_model_path(), atlas=False), onnx.load(default_model_path())
    a = model.description.acquisition
    residual = np.random.default_rng(seed).standard_normal(a.shape).astype(np.float32) * np.float32(size)
    features = make_features("frequency", a)
    features.extract(residual, model.features.reshape(features.shape))
    x_mm, y_mm = model.estimate()[:2]

    inside = _kept("inside", graphs.with_features_inside(graph, a), a.channels)
    inside.inputs[0] = residual
    inside()
    double = _kept("double", graphs.in_double(graph), 1)
    assert double.inputs.dtype == np.float64
    double.inputs[...] = model.features
    double()
    for network in (inside, double):
        assert network.outputs["position_mm"][0] == pytest.approx([x_mm, y_mm], abs=2e-3)


_NETWORKS: dict[str, BoundNetwork] = {}


def _kept(name: str, graph: onnx.ModelProto, rows: int) -> BoundNetwork:
    """Made once: hypothesis comes again and again."""
    if name not in _NETWORKS:
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            _NETWORKS[name] = written(graph, Path(folder), rows)
    return _NETWORKS[name]
