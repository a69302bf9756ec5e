"""Cache results of long computations on disk."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.errors import OutputError
from touchd.files import replacing
from touchd.jobs import digest

Arrays = dict[str, NDArray[np.float64]]


def folder() -> Path:
    """Return the cache folder: `$XDG_CACHE_HOME/touchd`, or `~/.cache/touchd`."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path("~/.cache").expanduser()) / "touchd"


@contextlib.contextmanager
def parts_kept(name: str, identity: Any) -> Iterator[Path | None]:
    """Yield the folder of a long job's finished parts, or None without a home folder; remove it after success.

    A run that is stopped goes on from them. `identity` is all that the parts depend on; see `touchd.jobs.digest`.
    """
    try:
        kept = folder() / "jobs" / f"{name}-{digest(identity)[:24]}"
    except RuntimeError:
        yield None
        return
    yield kept
    rmtree(kept, ignore_errors=True)


def remember(name: str, parameters: Mapping[str, Any], compute: Callable[[], Arrays]) -> Arrays:
    """Return the named arrays of `compute`, from disk if they were computed before with equal parameters.

    The file's name begins with `name`. `parameters` are all that the result depends on, with a version of the
    algorithm; JSON types only. An unwritable folder or a damaged file only costs computing again.
    """
    key = hashlib.sha256(json.dumps(parameters, sort_keys=True).encode()).hexdigest()[:24]
    try:
        path = folder() / f"{name}-{key}.npz"
    except RuntimeError:  # no home folder
        return compute()
    try:
        # Open the file here: numpy leaves its own open if the archive is damaged.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        pass  # absent or damaged: compute
    arrays = compute()
    with contextlib.suppress(OSError, OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as made:
            np.savez(made, **arrays)  # type: ignore[arg-type]  # numpy's stub confuses the names with allow_pickle
    return arrays
