"""Export a trained network to an ONNX file with touchd's metadata, and check it."""

from __future__ import annotations

import copy
import tempfile
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from touchd.errors import TrainingError
from touchd.localization.model import METADATA_KEY, Description, Model
from touchd.training.network.network import Network

OPSET = 17
TOLERANCE = 1e-4
"""Rounding errors of a network up to this size, mm or probability, are not worth a word."""
ANOTHER_FUNCTION = 0.02
"""Rounding makes no larger difference, mm or probability."""


def make_graph(network: Network, description: Description) -> onnx.ModelProto:
    """Convert a network to an ONNX graph and add its metadata."""
    names = list(network.outputs)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # The TorchScript exporter needs only torch and onnx; its deprecation warning does not concern the user.
        warnings.simplefilter("ignore", DeprecationWarning)
        file = Path(folder) / "model.onnx"
        torch.onnx.export(
            fold(network), (torch.ones(1, description.inputs),), file, dynamo=False, opset_version=OPSET,
            input_names=["features"], output_names=names,
            dynamic_axes={name: {0: "n"} for name in ["features", *names]},
        )  # fmt: skip
        graph: onnx.ModelProto = onnx.load(file)
    describe(graph, description)
    return graph


def describe(graph: onnx.ModelProto, description: Description) -> None:
    """Replace a graph's metadata."""
    del graph.metadata_props[:]
    graph.metadata_props.add(key=METADATA_KEY, value=description.model_dump_json())


def check_export(network: Network, model: Model, features: NDArray[np.float32]) -> float:
    """Return the largest difference between a trained network and its exported model, mm or probability.

    The network computes in float64, the model as in the daemon, so the difference is the rounding error of float32.
    Raises TrainingError if the difference is more than rounding.
    """
    with torch.inference_mode():
        said = copy.deepcopy(network).double().eval()(torch.from_numpy(features).double())
    trained = dict(zip(network.outputs, said if isinstance(said, tuple) else (said,), strict=True))
    exported = model.run(features)
    difference = max(float(np.abs(trained[name].numpy() - exported[name]).max()) for name in trained)
    if not difference <= ANOTHER_FUNCTION:  # negated, so that NaN fails too
        raise TrainingError(
            f"the exported model differs from the trained network by {difference:.2g} (at most {ANOTHER_FUNCTION:g})",
            "export",
            "report a bug, with the recording and the seed",
        )
    return difference


class Shift(nn.Module):
    """Subtracts a mean."""

    mean: Tensor

    def __init__(self, mean: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)

    def forward(self, features: Tensor) -> Tensor:
        """Return features less the mean, shape (n, inputs)."""
        return features - self.mean


def fold(network: Network) -> Network:
    """Return a copy with each batch normalisation folded into the linear layers after it.

    The function is unchanged, with fewer operations: W (g (x - m) / s + b) + c = W' x + c'.
    """
    folded = copy.deepcopy(network).eval()
    stages = folded.trunk
    # Plain spectra have means far above their variation: subtract the mean before the product, or lose digits.
    plain = getattr(folded, "normalise", None) is None
    for i in range(len(stages) - 1):
        norm, linear = stages[i], stages[i + 1]
        if isinstance(norm, nn.BatchNorm1d) and isinstance(linear, nn.Linear):
            stages[i] = _fold_into([linear], norm, shift=plain and i == 0)
    if isinstance(folded.last, nn.BatchNorm1d):
        folded.last = _fold_into(folded.heads(), folded.last, shift=False)
    return folded


def _fold_into(layers: list[nn.Linear] | tuple[nn.Linear, ...], norm: nn.BatchNorm1d, *, shift: bool) -> nn.Module:
    """Fold a normalisation into the layers after it, and return the module that replaces it.

    The products are computed in float64, because each rounded weight shifts every position.
    """
    assert norm.running_mean is not None
    assert norm.running_var is not None
    mean = norm.running_mean.detach().clone()
    scale = norm.weight.detach().double() / torch.sqrt(norm.running_var.double() + norm.eps)
    offset = norm.bias.detach().double() - (0.0 if shift else mean.double() * scale)
    with torch.no_grad():
        for layer in layers:
            weight = layer.weight.double()
            layer.bias.copy_(layer.bias.double() + weight @ offset)
            layer.weight.copy_(weight * scale)
    return Shift(mean) if shift else nn.Identity()
