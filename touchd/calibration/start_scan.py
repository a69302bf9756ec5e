"""Say where a finger has landed by comparing a frame with the atlas on a grid: a model file made without a network.

The energy that a finger at a node explains is |u^H d|^2 / |u|^2, u the field there and d the frame's bins. The products
with all nodes are two matrix products, so the scan is a small ONNX graph. Its inputs, outputs and metadata are those of
a trained regression model.
"""

from __future__ import annotations

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from touchd.calibration.reduced_plate import Floats
from touchd.localization.atlas import Atlas
from touchd.localization.features import band_bins
from touchd.localization.model import METADATA_KEY, Description
from touchd.training.field.place import FieldMap

GRID_STEPS = 1.3
"""Spacing of the grid in steps of the atlas: 3.2 mm on 5 mm glass, so that the nearest node is within
2.3 mm; Gauss-Newton converges from 4 mm."""
SPLIT_CELLS = 3
"""Outermost cells along each side with two nodes across it: beside a free edge the field turns within 1.5 mm, and a
grid of one spacing started 1 in 14 rigid tips 2 to 4 mm from the edge more than 4 mm off (twin)."""
EVERY_BIN = 3
"""Where each chirp meets a silent plate every third bin is enough: of 1,000 starts at 40 dB 2 are more than 4 mm off,
with all bins none; at 60 dB none either way (twin). In steady state no two bins are alike."""
MOST_BINS = 17
"""Of those that are not alike."""
HALF_CONFIDENCE = 0.6
"""At this unexplained share confidence is a half. A finger between four nodes leaves up to 0.5, noise 0.8 or more."""
OPSET, IR_VERSION = 17, 8


def _constants(atlas: Atlas) -> dict[str, NDArray[np.generic]]:
    """Return the graph's constants: m nodes of v values, both parts of some bins of all channels.

    `real` and `imaginary` are the indices of the features that are these parts, shape (v / 2,), `weight` theirs, `unit`
    the field of norm 1 at the nodes, shape (v, m), first the real parts, and `position` the nodes, shape (m, 2).
    """
    d = atlas.description
    spacing_mm = GRID_STEPS * d.step_mm
    x_mm, y_mm = (_cell_centres(length, spacing_mm) for length in d.plate.size_mm)
    position_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    every = -(-len(d.bins) // MOST_BINS) if d.acquisition.is_whole_period else EVERY_BIN
    channels, chosen = d.acquisition.channels, np.arange(0, len(d.bins), every)
    field = FieldMap(atlas).at(position_mm)[..., chosen]
    field = field.reshape(len(position_mm), -1)
    unit = np.concatenate([field.real, field.imag], axis=1).T
    unit /= np.maximum(np.linalg.norm(unit, axis=0), 1e-30)
    band = band_bins(d.acquisition)
    column = np.searchsorted(band, np.array(d.bins)[chosen])
    real = (2 * len(band) * np.arange(channels)[:, None] + column).ravel()
    constants: dict[str, NDArray[np.generic]] = {
        "real": real, "imaginary": real + len(band), "unit": unit.astype(np.float32),
        "weight": np.tile(d.bin_weights[chosen], channels).astype(np.float32),
        "position": position_mm.astype(np.float32),
    }  # fmt: skip
    numbers = {
        "zero": 0.0, "one": 1.0, "least": 1e-20, "half": HALF_CONFIDENCE, "four": 4.0,
        "spread": spacing_mm / np.sqrt(12),
    }  # fmt: skip
    return constants | {name: np.array(number, np.float32) for name, number in numbers.items()}


def start_scan(atlas: Atlas, description: Description) -> onnx.ModelProto:
    """Return the scan of an atlas as an ONNX graph with touchd's metadata."""
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
        [numpy_helper.from_array(array, name) for name, array in _constants(atlas).items()],
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
