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
from numpy.typing import NDArray
from torch import nn

from touchd.errors import OutputError, TrainingError
from touchd.model import METADATA_KEY, Description, Model
from touchd.training.network import Network

OPSET = 17
_OUTPUTS = {"regression": ["position_mm", "sigma_mm", "confidence"], "grid": ["probability"], "keypad": ["probability"]}


def export(network: Network, description: Description, path: Path) -> Model:
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


def fold(network: Network) -> Network:
    """Return a copy in which each batch normalisation is folded into the linear layers after it.

    The same function with fewer operations: W (g (x - m) / s + b) + c is W' x + c'.
    """
    folded = copy.deepcopy(network).eval()
    stages = folded.trunk
    # Plain spectra lie far from zero for what they vary: the mean has to go before the product, or digits do.
    plain = getattr(folded, "normalise", None) is None
    for i in range(int(plain), len(stages) - 1):
        norm, linear = stages[i], stages[i + 1]
        if isinstance(norm, nn.BatchNorm1d) and isinstance(linear, nn.Linear):
            _fold_into(linear, norm)
            stages[i] = nn.Identity()
    if isinstance(folded.last, nn.BatchNorm1d):
        for head in folded.heads():
            _fold_into(head, folded.last)
        folded.last = nn.Identity()
    return folded


def check(network: Network, model: Model, features: NDArray[np.float32], tolerance: float) -> float:
    """Return the largest difference between what a network and its exported model say, over all outputs.

    Raises
    ------
    TrainingError
        If it is more than the tolerance (mm, or probability).
    """
    with torch.inference_mode():
        said = network.eval()(torch.from_numpy(features))
    trained = said if isinstance(said, tuple) else (said,)
    exported = model.run(features).values()
    difference = max(float(np.abs(a.numpy() - b).max()) for a, b in zip(trained, exported, strict=True))
    if difference > tolerance:
        raise TrainingError(
            f"the exported model differs from the trained network by {difference:.2g} (at most {tolerance:g})",
            str(model.path),
            "report this with the recording and the seed",
        )
    return difference


def _to_onnx(network: Network, description: Description) -> onnx.ModelProto:
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
