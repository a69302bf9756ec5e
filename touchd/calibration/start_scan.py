"""Say where a finger has landed by comparing a frame with the atlas on a grid: a model file made without a network.

The energy that a finger at a node explains is |u^H d|^2 / |u|^2, u the field there and d the frame's bins. The products
with all nodes are two matrix products, so the scan is a small ONNX graph. Its inputs, outputs and metadata are those of
a trained regression model.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from touchd.localization.atlas import Atlas
from touchd.localization.features import band_bins
from touchd.localization.model import METADATA_KEY, Description
from touchd.training.field.place import FieldMap

Floats = NDArray[np.float64]

GRID_STEPS = 1.3
"""Spacing of the grid in steps of the atlas: 3.2 mm on 5 mm glass, so that the nearest node is within
2.3 mm; Gauss-Newton converges from 4 mm."""
SPLIT_CELLS = 3
"""Outermost cells along each side with two nodes across it: beside a free edge the field turns within 1.5 mm, and a
grid of one spacing started 1 in 14 rigid tips 2 to 4 mm from the edge more than 4 mm off (twin)."""
EVERY_BIN = 3
"""Hann's window correlates neighbouring bins: every third one tells as much (twin). Without a window none is alike."""
MOST_BINS = 17
"""Of those that are not alike."""
HALF_CONFIDENCE = 0.6
"""At this unexplained share confidence is a half. A finger between four nodes leaves up to 0.5, noise 0.8 or more."""
OPSET, IR_VERSION = 17, 8


class Scan(NamedTuple):
    """The field on a grid: m nodes of v values, both parts of some bins of all channels."""

    position_mm: Floats
    """Shape (m, 2)."""
    weight: NDArray[np.float32]
    """Of each value of a frame, shape (v,)."""
    unit: NDArray[np.float32]
    """Field of norm 1, shape (v, m): the real parts, then the imaginary parts."""
    real: NDArray[np.int64]
    """Indices of the features that are real parts, shape (v / 2,)."""
    imaginary: NDArray[np.int64]
    spacing_mm: float


def make_scan(atlas: Atlas) -> Scan:
    """Take the grid and its field from an atlas."""
    d = atlas.description
    width_mm, height_mm = d.plate.width_mm, d.plate.height_mm
    spacing_mm = GRID_STEPS * d.step_mm
    x_mm, y_mm = (_cell_centres(length, spacing_mm) for length in (width_mm, height_mm))
    position_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    every = -(-len(d.bins) // MOST_BINS) if d.acquisition.is_whole_period else EVERY_BIN
    channels, chosen = d.acquisition.channels, np.arange(0, len(d.bins), every)
    field = FieldMap(atlas).look_up(position_mm)[0].reshape(len(position_mm), channels, -1)[..., chosen]
    field = field.reshape(len(position_mm), -1)
    unit = np.concatenate([field.real, field.imag], axis=1).T
    unit /= np.maximum(np.linalg.norm(unit, axis=0), 1e-30)
    band = band_bins(d.acquisition)
    column = np.searchsorted(band, np.array(d.bins)[chosen])
    real = (2 * len(band) * np.arange(channels)[:, None] + column).ravel()
    weight = np.tile(d.bin_weights[chosen], 2 * channels).astype(np.float32)
    return Scan(position_mm, weight, unit.astype(np.float32), real, real + len(band), spacing_mm)


def scan(scanned: Scan, features: Floats) -> tuple[Floats, Floats, Floats]:
    """Return positions (n, 2), sigma (n, 1) and confidence (n, 1) for features (n, inputs): the graph's reference."""
    values = features[:, np.concatenate([scanned.real, scanned.imaginary])] * scanned.weight
    real, imaginary = np.split(values, 2, axis=1)
    along = np.concatenate([real, imaginary], axis=1) @ scanned.unit.astype(np.float64)
    across = np.concatenate([imaginary, -real], axis=1) @ scanned.unit.astype(np.float64)
    score = along**2 + across**2
    energy = np.square(real).sum(axis=1) + np.square(imaginary).sum(axis=1)
    share = 1 - score.max(axis=1) / np.maximum(energy, 1e-20)
    left = np.clip(share, 0.0, 1.0)[:, None]
    sigma_mm = scanned.spacing_mm / np.sqrt(12) * (1 + (left / HALF_CONFIDENCE) ** 4)
    return scanned.position_mm[score.argmax(axis=1)], sigma_mm, 1 / (1 + (left / HALF_CONFIDENCE) ** 4)


def make_graph(scanned: Scan, description: Description) -> onnx.ModelProto:
    """Return the scan as an ONNX graph with touchd's metadata."""
    constants: dict[str, NDArray[np.generic]] = {
        "real": scanned.real,
        "imaginary": scanned.imaginary,
        "unit": scanned.unit,
        "weight": scanned.weight[: len(scanned.real)],
        "position": scanned.position_mm.astype(np.float32),
    }
    numbers = {
        "zero": 0.0, "one": 1.0, "least": 1e-20, "half": HALF_CONFIDENCE, "four": 4.0,
        "spread": scanned.spacing_mm / np.sqrt(12),
    }  # fmt: skip
    constants |= {name: np.array(number, np.float32) for name, number in numbers.items()}
    make = helper.make_node
    nodes = [
        make("Gather", ["features", "real"], ["plain_re"], axis=1),
        make("Gather", ["features", "imaginary"], ["plain_im"], axis=1),
        make("Mul", ["plain_re", "weight"], ["d_re"]),
        make("Mul", ["plain_im", "weight"], ["d_im"]),
        make("Neg", ["d_re"], ["minus_re"]),
        make("Concat", ["d_re", "d_im"], ["d"], axis=1),
        make("Concat", ["d_im", "minus_re"], ["turned"], axis=1),
        make("MatMul", ["d", "unit"], ["along"]),
        make("MatMul", ["turned", "unit"], ["across"]),
        make("Mul", ["along", "along"], ["along2"]),
        make("Mul", ["across", "across"], ["across2"]),
        make("Add", ["along2", "across2"], ["score"]),
        make("ArgMax", ["score"], ["best"], axis=1, keepdims=0),
        make("Gather", ["position", "best"], ["position_mm"], axis=0),
        make("ReduceMax", ["score"], ["explained"], axes=[1], keepdims=1),
        make("ReduceSumSquare", ["d"], ["all"], axes=[1], keepdims=1),
        make("Max", ["all", "least"], ["energy"]),
        make("Div", ["explained", "energy"], ["share"]),
        make("Sub", ["one", "share"], ["rest"]),
        make("Clip", ["rest", "zero", "one"], ["left"]),
        make("Div", ["left", "half"], ["ratio"]),
        make("Pow", ["ratio", "four"], ["odds"]),
        make("Add", ["odds", "one"], ["doubt"]),
        make("Div", ["one", "doubt"], ["confidence"]),
        make("Mul", ["doubt", "spread"], ["sigma_mm"]),
    ]
    shapes = {"position_mm": 2, "sigma_mm": 1, "confidence": 1}
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes, "start_scan", [value("features", TensorProto.FLOAT, ["n", description.inputs])],
        [value(name, TensorProto.FLOAT, ["n", size]) for name, size in shapes.items()],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="touchd")
    model.ir_version = IR_VERSION
    model.metadata_props.add(key=METADATA_KEY, value=description.model_dump_json())
    return model


def _cell_centres(length_mm: float, spacing_mm: float) -> Floats:
    """Return the centres of cells of at most `spacing_mm` along a side; the outermost ones are halves."""
    count = int(np.ceil(length_mm / spacing_mm))
    cell_mm = length_mm / count
    split = min(SPLIT_CELLS, count // 2)
    outer_mm = cell_mm / 2 * (np.arange(2 * split) + 0.5)
    inner_mm = cell_mm * (np.arange(split, count - split) + 0.5)
    return np.concatenate([outer_mm, inner_mm, length_mm - outer_mm[::-1]])
