"""touchd itself in double precision: its own source, read again with float64 for float32, and networks in float64.

Every decision, every step and every stop is the fast path's own. So whatever a run of this differs by from a run of
the fast path is rounding, carried on from frame to frame, and nothing else. What is wrong in both is not seen this
way: that is what `tests.scenes.numerics.reference` is for.
"""

from __future__ import annotations

import importlib
import importlib.util
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import onnx

from touchd.lab.benchmark.graphs import in_double
from touchd.localization.atlas import atlas_path

SHARED = (
    "tracking", "tracking.assignment", "config", "config.schema", "outcome", "errors", "event", "tracking.one_euro",
    "frame", "detection", "detection.gate", "keypad", "tracking.keys", "recording", "recording.npz",
    "tracking.tracker", "touch", "recording.data", "recording.validate", "recording.format", "localization",
)  # fmt: skip
"""Modules that compute in float64 anyway, or hold nothing but plain data: both runs use the same ones."""
_WIDER = {"np.float32": "np.float64", "np.complex64": "np.complex128"}


class _Doubling(MetaPathFinder, Loader):
    """Finds touchd's modules as usual, and replaces the types in their source."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, _target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not fullname.startswith("touchd."):
            return None
        spec = PathFinder.find_spec(fullname, path)
        if spec is None or spec.origin is None or spec.submodule_search_locations is not None:
            return spec
        return importlib.util.spec_from_loader(fullname, self, origin=spec.origin)

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        origin = module.__spec__.origin
        assert origin is not None
        text = Path(origin).read_text()
        for single, double in _WIDER.items():
            text = text.replace(single, double)
        module.__file__ = origin
        exec(compile(text, f"<double> {origin}", "exec"), module.__dict__)


@contextmanager
def _own_modules() -> Iterator[None]:
    """For a while, import touchd's modules anew; afterwards those that were there are there again."""
    kept = {name: module for name, module in sys.modules.items() if name.startswith("touchd")}
    shared = {"touchd", *(f"touchd.{name}" for name in SHARED)}
    for name in kept:
        if name not in shared:
            del sys.modules[name]
    finder = _Doubling()
    attributes = {name: dict(vars(module)) for name, module in kept.items() if name in shared}
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in [name for name in sys.modules if name.startswith("touchd")]:
            del sys.modules[name]
        sys.modules.update(kept)
        for name, own in attributes.items():
            vars(kept[name]).update(own)


@cache
def double() -> Any:
    """The double-precision modules that a caller needs: `pipeline`, `finder`, `locator`, `refine`, `model`."""
    for name in SHARED:
        importlib.import_module(f"touchd.{name}")
    with _own_modules():
        names = (
            "pipeline", "localization.network_localizer", "localization.atlas_localizer", "localization.gauss_newton",
            "localization.drift", "localization.model", "detection.baseline",
        )  # fmt: skip
        return SimpleNamespace(**{name.rpartition(".")[2]: importlib.import_module(f"touchd.{name}") for name in names})


@cache
def double_model(path: Path) -> Any:
    """A shipped network computed in float64, with its atlas if it has one."""
    with tempfile.TemporaryDirectory() as folder:
        wide = Path(folder) / path.name
        wide.write_bytes(in_double(onnx.load(path)).SerializeToString())
        if atlas_path(path).exists():
            shutil.copy(atlas_path(path), atlas_path(wide))
        return double().model.Model(wide)


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
