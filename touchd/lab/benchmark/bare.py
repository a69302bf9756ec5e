"""The bare network: the source paper's regression network with random weights, the unit of all run times."""

from __future__ import annotations

from itertools import pairwise
from math import sqrt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchd.localization.model import _load as open_session  # so that both share the session options

WIDTHS = (392, 400, 300, 200, 100, 2)
"""Bahrami et al. 2022: 357,000 multiply-adds."""
OPSET, IR_VERSION = 17, 8


class BareNetwork:
    """The network on one thread, with buffers bound once, as the daemon runs its own; call it to run it once."""

    def __init__(self, path: Path) -> None:
        self._session = open_session(path)
        self._binding = self._session.io_binding()
        self._features = np.random.default_rng(0).standard_normal((1, WIDTHS[0])).astype(np.float32)
        self.position_mm: NDArray[np.float32] = np.zeros((1, WIDTHS[-1]), np.float32)
        for bind, name, buffer in (
            (self._binding.bind_input, "features", self._features),
            (self._binding.bind_output, "position_mm", self.position_mm),
        ):
            bind(name, "cpu", 0, np.float32, buffer.shape, buffer.ctypes.data)

    def __call__(self) -> None:
        """Run the network once."""
        self._session.run_with_iobinding(self._binding)


def write_bare(path: Path) -> Path:
    """Write the network; its run time does not depend on the weights.

    Batch normalisations are folded into the linear layers, as in every exported network.
    """
    from onnx import TensorProto, helper, numpy_helper  # would count as memory of the measured daemon

    rng = np.random.default_rng(0)
    nodes, weights, name = [], [], "features"
    for stage, (inputs, outputs) in enumerate(pairwise(WIDTHS)):
        weight = rng.standard_normal((outputs, inputs)) * sqrt(2 / inputs)
        weights += [
            numpy_helper.from_array(weight.astype(np.float32), f"weight{stage}"),
            numpy_helper.from_array(np.full(outputs, 0.1, np.float32), f"bias{stage}"),
        ]
        last = stage == len(WIDTHS) - 2
        product = "position_mm" if last else f"product{stage}"
        nodes.append(helper.make_node("Gemm", [name, f"weight{stage}", f"bias{stage}"], [product], transB=1))
        name = f"stage{stage}"
        if not last:
            nodes.append(helper.make_node("Relu", [product], [name]))
    features, position_mm = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ("n", width))
        for name, width in (("features", WIDTHS[0]), ("position_mm", WIDTHS[-1]))
    )
    graph = helper.make_graph(nodes, "bare", [features], [position_mm], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    path.write_bytes(model.SerializeToString())
    return path
