"""From a trained network to one ONNX file that carries its own description."""

from __future__ import annotations

import copy
import os
import tempfile
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import nn

from touchd.errors import OutputError, TrainingError
from touchd.model import METADATA_KEY, Description, Model

OPSET = 17
_OUTPUTS = {"regression": ["position_mm", "sigma_mm", "confidence"], "grid": ["probability"], "keypad": ["probability"]}


def export(network: nn.Module, description: Description, path: Path) -> Model:
    """Write the network with its description to `path`, whole or not at all, and return it loaded.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    proto = _to_onnx(fold(network), description)
    entry = proto.metadata_props.add()
    entry.key = METADATA_KEY
    entry.value = description.model_dump_json()
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            file.write(proto.SerializeToString())
        Path(file.name).chmod(0o644)
        os.replace(file.name, path)
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror})", str(path), "check the folder and its space"
        ) from error
    return Model(path)


def fold(network: nn.Module) -> nn.Module:
    """Return a copy in which each batch normalisation is folded into the linear layer after it.

    The same function with fewer operations: W (g (x - m) / s + b) + c is W' x + c'.
    """
    folded = copy.deepcopy(network).eval()
    previous: tuple[nn.Module, str, nn.BatchNorm1d] | None = None
    for parent in [m for m in folded.modules() if not isinstance(m, nn.Linear)]:
        for name, child in list(parent.named_children()):
            if isinstance(child, nn.BatchNorm1d):
                previous = (parent, name, child)
            elif isinstance(child, nn.Linear) and previous is not None:
                _fold_into(child, previous[2])
                setattr(previous[0], previous[1], nn.Identity())
                previous = None
    return folded


def check(network: nn.Module, model: Model, features: np.ndarray, tolerance: float) -> float:
    """Return the largest difference between a network's and its exported model's first output.

    Raises
    ------
    TrainingError
        If it is more than the tolerance (mm for a position, else probability).
    """
    with torch.inference_mode():
        trained = network.eval()(torch.from_numpy(features))
    first = trained[0] if isinstance(trained, tuple) else trained
    exported = next(iter(model.run(features).values()))
    difference = float(np.abs(first.numpy() - exported).max())
    if difference > tolerance:
        raise TrainingError(
            f"the exported model differs from the trained network by {difference:.2g} (at most {tolerance:g})",
            str(model.path),
            "report this with the recording and the seed",
        )
    return difference


def _to_onnx(network: nn.Module, description: Description) -> onnx.ModelProto:
    names = _OUTPUTS[description.head]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # The TorchScript exporter needs no package beyond torch and onnx; its notice of age is no news to the user.
        warnings.simplefilter("ignore", DeprecationWarning)
        file = Path(folder) / "model.onnx"
        torch.onnx.export(
            network,
            (torch.ones(1, description.inputs),),
            file,
            dynamo=False,
            opset_version=OPSET,
            input_names=["features"],
            output_names=names,
            dynamic_axes={name: {0: "n"} for name in ["features", *names]},
        )
        return onnx.load(file)


def _fold_into(linear: nn.Linear, norm: nn.BatchNorm1d) -> None:
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = (norm.weight / torch.sqrt(norm.running_var + norm.eps)).detach()
    shift = norm.bias.detach() - norm.running_mean * scale
    with torch.no_grad():
        linear.bias.add_(linear.weight @ shift)
        linear.weight.mul_(scale)
