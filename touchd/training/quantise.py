"""A model with weights of 8 bits: a quarter of the memory to read for each touch."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

import onnx
from onnxruntime.quantization import QuantType, quantize_dynamic

from touchd.errors import TrainingError
from touchd.evaluation.score import judge, scores
from touchd.model import Model
from touchd.recording import Recording
from touchd.training.dataset import make_dataset, split
from touchd.training.export import describe, write_model


def quantise(model: Model, recording: Recording, path: Path) -> Model:
    """Write a model's integer version to `path` and return it loaded, with scores of its own.

    Each column of the weights has a scale, and so has each frame's vector of activations, which is found
    while it is computed: so no touches are needed to calibrate it, and weak ones lose no more than strong
    ones. The scores are those of the recording's test part.

    Raises
    ------
    TrainingError
        If the recording is not the one that the model was trained on: then which touches it has never seen
        is not known. Or if the model is an integer one already.
    """
    description = model.description
    data = make_dataset(recording, description.domain)
    if data.sha256 != description.data_sha256:
        raise TrainingError(
            "not the recording that the model was trained on, whose test part would judge the integer version",
            str(model.path),
            "give the recording named in the model's command",
        )
    if description.precision != "float32":
        raise TrainingError(f"the weights are {description.precision} already", str(model.path), "give the original")
    with tempfile.TemporaryDirectory() as folder:
        small = Path(folder) / "int8.onnx"
        logging.getLogger().addFilter(_hush)  # it advises a pre-processing that the export has done
        try:
            quantize_dynamic(model.path, small, per_channel=True, weight_type=QuantType.QInt8)
        finally:
            logging.getLogger().removeFilter(_hush)
        graph = onnx.load(small)
    stated = description.model_copy(update={"precision": "int8"})
    describe(graph, stated)
    test = split(len(data), description.seed).test
    features = data.residual if description.input == "residual" else data.signal
    with tempfile.TemporaryDirectory() as folder:
        made = write_model(graph, Path(folder) / "int8.onnx")
        found = scores(judge(made, features[test], data.position_mm[test], data.noise_energy))
    rounded = {name: round(value, 4) for name, value in found.items()}
    describe(graph, stated.model_copy(update={"scores": rounded}))
    return write_model(graph, path)


def _hush(record: logging.LogRecord) -> bool:
    return "pre-processing" not in record.getMessage()
