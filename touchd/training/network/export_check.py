"""Check that an exported graph computes the trained network's function, and measure its rounding error."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator

from touchd.errors import TrainingError
from touchd.training.network.zones_and_keys import Network

TOLERANCE = 1e-4
"""Largest allowed difference, mm or probability."""


@dataclass(frozen=True, slots=True)
class ExportDifference:
    """Largest differences over touches and outputs: mm, or probability for confidence and classes."""

    function: float
    """Trained network against exported graph, both in float64; at most `TOLERANCE`. Weights are stored in float32."""
    rounding: float
    """Trained network in float64 against exported graph in float32, as the daemon runs it."""


def check_graph(network: Network, graph: onnx.ModelProto, features: NDArray[np.float32]) -> ExportDifference:
    """Compare a trained network with its exported graph on features of shape (n, inputs).

    In float32 two runtimes differ by their order of summation; in float64 any difference above `TOLERANCE` is a
    difference of the function.

    Raises
    ------
    TrainingError
        The functions differ by more than `TOLERANCE`.
    """
    with torch.inference_mode():
        said = copy.deepcopy(network).double().eval()(torch.from_numpy(features).double())
    trained = [part.numpy() for part in (said if isinstance(said, tuple) else (said,))]
    # Use ONNX's reference operators: onnxruntime has some operators in float32 only.
    defined = ReferenceEvaluator(_in_float64(graph))
    name = graph.graph.input[0].name
    function = _difference(trained, list(defined.run(None, {name: features.astype(np.float64)})))
    # Negated, so that NaN fails too.
    if not function <= TOLERANCE:
        raise TrainingError(
            f"the exported model differs from the trained network by {function:.2g} (at most {TOLERANCE:g})",
            "export",
            "report a bug, with the recording and the seed",
        )
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1  # as in the daemon
    session = ort.InferenceSession(graph.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return ExportDifference(function, _difference(trained, session.run(None, {name: features})))


def _difference(one: list[NDArray[Any]], two: list[Any]) -> float:
    return max(float(np.abs(a - b).max()) for a, b in zip(one, two, strict=True))


def _in_float64(graph: onnx.ModelProto) -> onnx.ModelProto:
    """Return a copy of a graph with every float32 converted to float64."""
    double = onnx.ModelProto()
    double.CopyFrom(graph)
    for tensor in double.graph.initializer:
        _widen(tensor)
    for node in double.graph.node:
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.TENSOR:
                _widen(attribute.t)
            elif node.op_type == "Cast" and attribute.name == "to" and attribute.i == onnx.TensorProto.FLOAT:
                attribute.i = onnx.TensorProto.DOUBLE
    for value in (*double.graph.input, *double.graph.output, *double.graph.value_info):
        if value.type.tensor_type.elem_type == onnx.TensorProto.FLOAT:
            value.type.tensor_type.elem_type = onnx.TensorProto.DOUBLE
    return double


def _widen(tensor: onnx.TensorProto) -> None:
    if tensor.data_type == onnx.TensorProto.FLOAT:
        values = onnx.numpy_helper.to_array(tensor).astype(np.float64)
        tensor.CopyFrom(onnx.numpy_helper.from_array(values, tensor.name))
