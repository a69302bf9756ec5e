"""ONNX graphs of the benchmark: the paper's network, and variants of a shipped one."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from touchd.frame import Acquisition
from touchd.localization.features import windowed_dft

BARE_WIDTHS = (392, 400, 300, 200, 100, 2)
"""The source paper's regression network (Bahrami et al. 2022): 357,000 multiply-adds."""
OPSET, IR_VERSION = 17, 8
_PRODUCTS = ("Gemm", "MatMul", "MatMulInteger")


def bare_network(seed: int = 0) -> onnx.ModelProto:
    """Return the paper's regression network with random weights, on which its run time does not depend.

    Batch normalisations are folded into the linear layers, as in every exported network.
    """
    rng = np.random.default_rng(seed)
    nodes, weights, name = [], [], "features"
    for stage, (inputs, outputs) in enumerate(pairwise(BARE_WIDTHS)):
        weight = rng.standard_normal((outputs, inputs)) * math.sqrt(2 / inputs)
        weights += [
            numpy_helper.from_array(weight.astype(np.float32), f"weight{stage}"),
            numpy_helper.from_array(np.full(outputs, 0.1, np.float32), f"bias{stage}"),
        ]
        last = stage == len(BARE_WIDTHS) - 2
        product = "position_mm" if last else f"product{stage}"
        nodes.append(helper.make_node("Gemm", [name, f"weight{stage}", f"bias{stage}"], [product], transB=1))
        name = f"stage{stage}"
        if not last:
            nodes.append(helper.make_node("Relu", [product], [name]))
    graph = helper.make_graph(
        nodes, "bare",
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, ("n", BARE_WIDTHS[0]))],
        [helper.make_tensor_value_info("position_mm", TensorProto.FLOAT, ("n", BARE_WIDTHS[-1]))],
        weights,
    )  # fmt: skip
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)


def with_features_inside(model: onnx.ModelProto, acquisition: Acquisition) -> onnx.ModelProto:
    """Return a network that takes samples (n, channels, samples): its first product is the windowed DFT."""
    made = onnx.ModelProto()
    made.CopyFrom(model)
    graph = made.graph
    features = graph.input[0].name
    size = acquisition.channels * windowed_dft(acquisition).shape[1]
    graph.initializer.extend([
        numpy_helper.from_array(windowed_dft(acquisition).astype(np.float32), "windowed_dft"),
        numpy_helper.from_array(np.array([-1, size], np.int64), "features_shape"),
    ])  # fmt: skip
    graph.node.insert(0, helper.make_node("MatMul", ["samples", "windowed_dft"], ["bins"]))
    graph.node.insert(1, helper.make_node("Reshape", ["bins", "features_shape"], [features]))
    del graph.input[:]
    graph.input.append(helper.make_tensor_value_info("samples", TensorProto.FLOAT, ("n", *acquisition.shape)))
    return made


def in_double(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return the network computed in float64, with its float32 weights."""
    made = onnx.ModelProto()
    made.CopyFrom(model)
    for tensor in (*made.graph.initializer, *(a.t for n in made.graph.node for a in n.attribute if a.name == "value")):
        if tensor.data_type == TensorProto.FLOAT:
            tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float64), tensor.name))
    for value in (*made.graph.input, *made.graph.output, *made.graph.value_info):
        if value.type.tensor_type.elem_type == TensorProto.FLOAT:
            value.type.tensor_type.elem_type = TensorProto.DOUBLE
    return made


def multiply_adds(model: onnx.ModelProto) -> int:
    """Return the multiply-adds of the matrix products, for one row of features."""
    sizes = {name: size for name, size, _ in _constants(model)}
    return sum(sizes.get(node.input[1], 0) for node in model.graph.node if node.op_type in _PRODUCTS)


def weight_bytes(model: onnx.ModelProto) -> int:
    """Return the bytes of constants that one inference reads."""
    return sum(size_bytes for _, _, size_bytes in _constants(model))


def _constants(model: onnx.ModelProto) -> list[tuple[str, int, int]]:
    """Return name, size and bytes of each constant."""
    found = [(tensor.name, tensor) for tensor in model.graph.initializer]
    found += [
        (node.output[0], node.attribute[0].t)
        for node in model.graph.node
        if node.op_type == "Constant" and node.attribute[0].name == "value"
    ]
    return [(name, math.prod(tensor.dims), numpy_helper.to_array(tensor).nbytes) for name, tensor in found]
