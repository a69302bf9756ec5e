"""The pipeline in double precision: a shipped network and its atlas in float64, from which all arrays take their type.

Every decision, every step and every stop is the fast path's own. A run of this therefore differs from a run of the fast
path by rounding alone, carried from frame to frame. What is wrong in both shows in `tests.scenes.numerics.reference`.
"""

from __future__ import annotations

import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper

from touchd.localization.atlas import atlas_path
from touchd.localization.model import Model


def in_double(model: onnx.ModelProto) -> onnx.ModelProto:
    """The network computed in float64, with its float32 weights."""
    made = onnx.ModelProto()
    made.CopyFrom(model)
    for tensor in (*made.graph.initializer, *(a.t for n in made.graph.node for a in n.attribute if a.name == "value")):
        if tensor.data_type == TensorProto.FLOAT:
            tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float64), tensor.name))
    for value in (*made.graph.input, *made.graph.output, *made.graph.value_info):
        if value.type.tensor_type.elem_type == TensorProto.FLOAT:
            value.type.tensor_type.elem_type = TensorProto.DOUBLE
    return made


@cache
def double_model(path: Path) -> Model:
    """A shipped network computed in float64, with its atlas if it has one."""
    with tempfile.TemporaryDirectory() as folder:
        wide = Path(folder) / path.name
        wide.write_bytes(in_double(onnx.load(path)).SerializeToString())
        if atlas_path(path).exists():
            shutil.copy(atlas_path(path), atlas_path(wide))
        return Model(wide)


def narrow_arrays(thing: Any) -> list[str]:
    """The names of all arrays of single precision that an object holds, however deeply."""
    found: list[str] = []
    seen: set[int] = set()

    def look(value: Any, name: str) -> None:
        if id(value) in seen:
            return
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            if value.dtype in (np.float32, np.complex64):
                found.append(name)
        elif isinstance(value, list | tuple):
            for number, item in enumerate(value):
                look(item, f"{name}[{number}]")
        elif isinstance(value, dict):
            for key, item in value.items():
                look(item, f"{name}[{key!r}]")
        elif type(value).__module__.startswith("touchd"):
            slots = [slot for kind in type(value).__mro__ for slot in getattr(kind, "__slots__", ())]
            inside = getattr(value, "__dict__", {}) | {slot: getattr(value, slot, None) for slot in slots}
            for key, item in inside.items():
                look(item, f"{name}.{key}")

    look(thing, type(thing).__name__)
    return found
