"""Export a trained network to an ONNX graph with touchd's metadata, and check it; quantise a model to 8 bits."""

from __future__ import annotations

import copy
import logging
import tempfile
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnxruntime.quantization import QuantType, quantize_dynamic
from torch import Tensor, nn

from touchd.errors import TrainingError
from touchd.evaluation.dataset import make_dataset, split
from touchd.evaluation.model_scores import Judgement, judge, scores
from touchd.localization.model import METADATA_KEY, Description, Model
from touchd.localization.model_file import put_model
from touchd.recording.data import Recording
from touchd.training.field.error_scale import WITHIN
from touchd.training.network.network import Network

OPSET = 17
TOLERANCE = 1e-4
"""Rounding errors of a network up to this size, mm or probability, are not worth a word."""
ANOTHER_FUNCTION = 0.02
"""Rounding makes no larger difference, mm or probability."""
ERROR_BIAS = "log_error.bias"
"""Bias of the log-sigma layer of `touchd.training.network.network.PositionNetwork`, by its name in the export."""


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


def quantise(model: Model, recording: Recording, path: Path) -> Model:
    """Quantise a model's weights to 8 bits, write the result to `path` and load it.

    Each weight column has a scale; activations are scaled per frame at run time, so no calibration touches are needed
    and weak touches lose no more precision than strong ones. The predicted standard errors grow as much as the errors
    of the validation part. The model's metadata receive its scores on the recording's test part. Raises TrainingError
    if the model was trained on another recording, so its test part is unknown; or it is quantised already.
    """
    description = model.description
    data = make_dataset(recording, description.domain, taper=description.taper)
    if data.sha256 != description.data_sha256:
        raise TrainingError(
            "the model was trained on another recording, so its test part is unknown",
            str(model.path),
            "give the very recording named in the model's command: other computers round some counts of a simulation "
            "otherwise",
        )
    if description.precision != "float32":
        raise TrainingError(f"the weights are {description.precision} already", str(model.path), "give the original")
    parts = split(len(data), description.seed)
    features = data.residual if description.input == "residual" else data.signal

    def judged(one: Model, part: NDArray[np.int64]) -> Judgement:
        return judge(one, features[part], data.position_mm[part], data.noise_energy)

    with tempfile.TemporaryDirectory() as folder:
        small = Path(folder) / "int8.onnx"
        logging.getLogger().addFilter(_hush)  # hides advice to pre-process, which the export has done
        try:
            quantize_dynamic(model.path, small, per_channel=True, weight_type=QuantType.QInt8)
        finally:
            logging.getLogger().removeFilter(_hush)
        graph = onnx.load(small)
        stated = description.model_copy(update={"precision": "int8"})
        describe(graph, stated)
        if "noise_mm" in model.outputs:
            narrow = put_model(graph.SerializeToString(), small)
            _widen(graph, _spread(judged(narrow, parts.validation)) / _spread(judged(model, parts.validation)))
        found = scores(judged(put_model(graph.SerializeToString(), small), parts.test))
    rounded = {name: round(value, 4) for name, value in found.items()}
    describe(graph, stated.model_copy(update={"scores": rounded}))
    return put_model(graph.SerializeToString(), path)


def _spread(judged: Judgement) -> float:
    """Return the 68 % quantile of the error per axis, in predicted standard errors."""
    return float(np.quantile(np.abs(judged.error_mm) / judged.sigma_mm[:, None], WITHIN))


def _widen(graph: onnx.ModelProto, factor: float) -> None:
    """Multiply a graph's predicted standard errors by `factor`, through the bias of their logarithm."""
    (bias,) = (tensor for tensor in graph.graph.initializer if tensor.name == ERROR_BIAS)
    wider = onnx.numpy_helper.to_array(bias) + np.float32(np.log(factor))
    bias.CopyFrom(onnx.numpy_helper.from_array(wider, bias.name))


def _hush(record: logging.LogRecord) -> bool:
    return "pre-processing" not in record.getMessage()
