"""Cache results of long computations on disk."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[np.float64]]


def folder() -> Path:
    """Return the cache folder: `$XDG_CACHE_HOME/touchd`, or `~/.cache/touchd`."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path("~/.cache").expanduser()) / "touchd"


def remember(name: str, parameters: Mapping[str, Any], compute: Callable[[], Arrays]) -> Arrays:
    """Return the result of `compute`, from disk if it was computed before with equal parameters.

    An unwritable folder or a damaged file only costs computing again.

    Parameters
    ----------
    name : str
        First part of the file's name.
    parameters : mapping
        Everything the result depends on, with a version of the algorithm; JSON types only.
    compute : callable
        Returns named arrays.
    """
    digest = hashlib.sha256(json.dumps(parameters, sort_keys=True).encode()).hexdigest()[:24]
    try:
        path = folder() / f"{name}-{digest}.npz"
        # Open the file here: numpy leaves its own open if the archive is damaged.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except (OSError, RuntimeError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        pass  # absent, damaged, or no home folder: compute
    arrays = compute()
    with contextlib.suppress(OSError, RuntimeError):
        _write(path, arrays)
    return arrays


def _write(path: Path, arrays: Arrays) -> None:
    """Write to a temporary name, then rename, so that another process sees the whole file or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".part-")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]  # numpy's stub confuses the names with allow_pickle
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
