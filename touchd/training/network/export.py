"""From a trained network to one ONNX file that carries its own description."""

from __future__ import annotations

import copy
import os
import tempfile
import warnings
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn

from touchd.errors import OutputError
from touchd.localization.model import METADATA_KEY, Description, Model
from touchd.training.network.network import Network

OPSET = 17


def make_graph(network: Network, description: Description) -> onnx.ModelProto:
    """Return the network as a graph with its description inside."""
    names = list(network.outputs)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # The TorchScript exporter needs no package beyond torch and onnx; its notice of age is no news to the user.
        warnings.simplefilter("ignore", DeprecationWarning)
        file = Path(folder) / "model.onnx"
        torch.onnx.export(
            fold(network),
            (torch.ones(1, description.inputs),),
            file,
            dynamo=False,
            opset_version=OPSET,
            input_names=["features"],
            output_names=names,
            dynamic_axes={name: {0: "n"} for name in ["features", *names]},
        )
        graph: onnx.ModelProto = onnx.load(file)
    describe(graph, description)
    return graph


def describe(graph: onnx.ModelProto, description: Description) -> None:
    """Put a description into a graph, in place of any there."""
    del graph.metadata_props[:]
    graph.metadata_props.add(key=METADATA_KEY, value=description.model_dump_json())


def write_model(graph: onnx.ModelProto, path: Path) -> Model:
    """Write a graph that carries its description to `path`, whole or not at all, and return it loaded.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    return put_model(graph.SerializeToString(), path)


def put_model(content: bytes, path: Path) -> Model:
    """Write an ONNX file's bytes to `path`, whole or not at all, and return it loaded; raises as `write_model`."""
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            file.write(content)
        Path(file.name).chmod(0o644)
        os.replace(file.name, path)
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror})", str(path), "check the folder and its space"
        ) from error
    return Model(path)


class Shift(nn.Module):
    """Takes a mean away."""

    mean: Tensor

    def __init__(self, mean: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)

    def forward(self, features: Tensor) -> Tensor:
        """Return features less the mean, shape (n, inputs)."""
        return features - self.mean


def fold(network: Network) -> Network:
    """Return a copy in which each batch normalisation is folded into the linear layers after it.

    The same function with fewer operations: W (g (x - m) / s + b) + c is W' x + c'.
    """
    folded = copy.deepcopy(network).eval()
    stages = folded.trunk
    # Plain spectra lie far from zero for what they vary by: their mean has to go before any product, or digits do.
    plain = getattr(folded, "normalise", None) is None
    for i in range(len(stages) - 1):
        norm, linear = stages[i], stages[i + 1]
        if isinstance(norm, nn.BatchNorm1d) and isinstance(linear, nn.Linear):
            stages[i] = _fold_into([linear], norm, shift=plain and i == 0)
    if isinstance(folded.last, nn.BatchNorm1d):
        folded.last = _fold_into(folded.heads(), folded.last, shift=False)
    return folded


def _fold_into(layers: list[nn.Linear] | tuple[nn.Linear, ...], norm: nn.BatchNorm1d, *, shift: bool) -> nn.Module:
    """Fold a normalisation into the layers after it, and return what stays in its place.

    In float64, since each rounding of a weight moves every position.
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
