"""What a result depends on, as one digest: function, arguments, shared objects, source code, numeric libraries."""

from __future__ import annotations

import ast
import dataclasses
import enum
import hashlib
import importlib.metadata
import importlib.util
import platform
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel

LIBRARIES = ("numpy", "scipy", "scikit-learn", "torch", "onnx", "onnxruntime")
"""A new version of one of these may round differently."""


def digest(value: Any) -> str:
    """Return the SHA-256 of a value's canonical form, in hexadecimal digits.

    Knows None, booleans, numbers, text, bytes, paths, enumerations, sequences, sets, mappings, numpy's arrays and
    scalars, dataclasses and pydantic models. A list and a tuple of the same values are the same.

    Raises
    ------
    TypeError
        For any other type, since nothing tells what its value is.
    """
    sha256 = hashlib.sha256()
    for part in _canonical(value):
        sha256.update(part)
    return sha256.hexdigest()


def _canonical(value: Any) -> Iterator[bytes | memoryview]:
    """Yield bytes that differ for different values: every part begins with its kind and its length."""
    match value:
        case enum.Enum():
            yield _head("enum", f"{_name(value)}.{value.name}")
        case np.ndarray() | np.generic():
            array = np.ascontiguousarray(value)
            if array.dtype.hasobject:
                raise TypeError(f"an array of {array.dtype} has no digest")
            yield _head("array", f"{array.dtype.descr}{np.shape(value)}")
            yield array.reshape(-1).view(np.uint8).data
        case None | bool() | int() | float() | complex():
            yield _head("number", repr(value))
        case str() | PurePath():
            yield _head("text", str(value))
        case bytes() | bytearray() | memoryview():
            yield _head("bytes", str(len(value)))
            yield bytes(value)
        case Mapping():
            entries = sorted((digest(key), item) for key, item in value.items())
            yield _head("mapping", str(len(entries)))
            for key, item in entries:
                yield key.encode()
                yield from _canonical(item)
        case list() | tuple():
            yield _head("sequence" if type(value) in (list, tuple) else _name(value), str(len(value)))
            for item in value:
                yield from _canonical(item)
        case set() | frozenset():
            yield _head("set", str(len(value)))
            for item in sorted(digest(item) for item in value):
                yield item.encode()
        case BaseModel():
            yield _head("object", _name(value))
            yield from _canonical(dict(value))
        case _ if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield _head("object", _name(value))
            yield from _canonical({field.name: getattr(value, field.name) for field in dataclasses.fields(value)})
        case _:
            raise TypeError(
                f"an object of type {_name(value)} has no digest: give it as Shared, with a digest of yours"
            )


def _head(kind: str, text: str) -> bytes:
    encoded = text.encode()
    return f"{kind} {len(encoded)} ".encode() + encoded


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
    """Digest the source of a module and of all that it imports, directly or not, from touchd or its own package.

    An import counts wherever it stands, also within a function. Other files that a function reads do not: their digests
    belong into its arguments. Read once a process, since what has been imported does not change either.
    """
    packages = {"touchd", module.partition(".")[0]}
    sources: dict[str, bytes] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        path = None if name in sources else _source(name)
        if path is None:
            continue
        sources[name] = path.read_bytes()
        # The packages around a module are imported before it.
        parents = [name.rpartition(".")[0]] if "." in name else []
        is_package = path.name == "__init__.py"
        imported = _imports(ast.parse(sources[name]), name if is_package else name.rpartition(".")[0])
        waiting += [other for other in [*parents, *imported] if other.partition(".")[0] in packages]
    return digest(sources)


def _imports(tree: ast.AST, package: str) -> Iterator[str]:
    """Yield every name that may be an imported module's; `package` is where relative imports begin."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package or None)
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


@cache
def _source(module: str) -> Path | None:
    """Return a module's file without importing it; None if there is none, as for a name that is no module."""
    top, *rest = module.split(".")
    spec = importlib.util.find_spec(top)
    if spec is None:
        return None
    if not rest:
        return Path(spec.origin) if spec.origin and spec.origin.endswith(".py") else None
    for folder in spec.submodule_search_locations or ():
        stem = Path(folder, *rest)
        for path in (stem.with_suffix(".py"), stem / "__init__.py"):
            if path.is_file():
                return path
    return None
