"""What a result depends on, as one digest: function, arguments, shared objects, source code, numeric libraries."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import importlib.util
import platform
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

LIBRARIES = ("numpy", "scipy", "torch", "onnx", "onnxruntime")
"""A new version of one of these may round differently."""


def digest(value: Any) -> str:
    """Return the SHA-256 of a value's canonical form, in hexadecimal digits.

    Knows None, booleans, numbers, text, bytes, sequences, mappings, numpy's arrays and scalars, dataclasses and
    pydantic models. A list and a tuple of the same values are the same.

    Raises
    ------
    TypeError
        For any other type, since nothing tells what its value is.
    """
    return hashlib.sha256(repr(_canonical(value)).encode()).hexdigest()


def _canonical(value: Any) -> Any:
    """Return what differs for different values, of types whose `repr` does too."""
    match value:
        case np.ndarray() | np.generic() if not value.dtype.hasobject:
            content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
            return "array", value.dtype.descr, np.shape(value), content
        case None | bool() | int() | float() | str() | bytes():
            return value
        case list() | tuple():
            return [_canonical(item) for item in value]
        case Mapping():
            return "mapping", sorted((repr(_canonical(key)), _canonical(item)) for key, item in value.items())
        case BaseModel():
            return _name(value), _canonical(dict(value))
        case _ if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return _name(value), [_canonical(getattr(value, field.name)) for field in dataclasses.fields(value)]
    raise TypeError(f"an object of type {_name(value)} has no digest: give it as Shared, with a digest of yours")


def _name(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"


@cache
def libraries() -> tuple[tuple[str, str], ...]:
    """Return the versions of Python and of the numeric libraries that are installed, and the kind of processor."""
    versions = [("python", platform.python_version()), ("machine", platform.machine())]
    for library in LIBRARIES:
        try:
            versions.append((library, importlib.metadata.version(library)))
        except importlib.metadata.PackageNotFoundError:
            versions.append((library, ""))
    return tuple(versions)


@cache
def code_digest(module: str) -> str:
    """Digest the source of touchd and of the package that a module is in.

    Other files that a function reads do not count: their digests belong into its arguments. Read once a process, since
    what has been imported does not change either.
    """
    sources = {}
    for package in {"touchd", module.partition(".")[0]}:
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.submodule_search_locations:
            folder = Path(next(iter(spec.submodule_search_locations)))
            for path in folder.rglob("*.py"):
                sources[package, path.relative_to(folder).as_posix()] = path.read_bytes()
    return digest(sources)
