"""Quantise a model's weights to 8 bits: a quarter of the memory traffic per touch."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnxruntime.quantization import QuantType, quantize_dynamic

from touchd.errors import TrainingError
from touchd.evaluation.dataset import make_dataset, split
from touchd.evaluation.model_scores import Judgement, judge, scores
from touchd.localization.model import Model
from touchd.localization.model_file import put_model
from touchd.recording.data import Recording
from touchd.training.field.error_scale import WITHIN
from touchd.training.network.export import describe

ERROR_BIAS = "log_error.bias"
"""Bias of the log-sigma layer of `touchd.training.network.network.PositionNetwork`, by its name in the export."""


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
            "give the recording named in the model's command",
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
