"""A job, the large objects that jobs share, what its result depends on, as one digest, and how a process runs one."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import importlib.util
import os
import pickle
import platform
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel

from touchd.errors import JobError, TouchdError

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment variables that libraries of linear algebra read when they are loaded."""
LIBRARIES = ("numpy", "scipy", "torch", "onnx", "onnxruntime")
"""A new version of one of these may round differently."""

Ended = tuple[str, bytes | TouchdError]
"""The name of a job that has ended, and its pickled result, or why it has none."""


@dataclass(frozen=True, slots=True)
class Job:
    """One part of a long computation."""

    name: str
    """Unique in a run, for people."""
    function: Callable[..., Any]
    """A module's function, so that workers can import it."""
    arguments: Mapping[str, Any]
    """By name; small, and of types that `touchd.jobs.digest` knows."""
    shared: tuple[str, ...] = ()
    """Names of shared objects, passed to the function as further arguments of these names."""

    def __post_init__(self) -> None:
        module, name = self.function.__module__, self.function.__qualname__
        if module == "__main__" or getattr(sys.modules.get(module), name, None) is not self.function:
            raise TypeError(f"a job's function must be one of a module that can be imported, not {module}.{name}")

    def key(self, code: str, shared: Mapping[str, str]) -> str:
        """Digest everything that the result depends on: not the name, but the digests of code and shared objects."""
        function = f"{self.function.__module__}.{self.function.__qualname__}"
        return digest([function, self.arguments, [shared[name] for name in self.shared], code, libraries()])


@dataclass(frozen=True, slots=True)
class Shared:
    """A large object that many jobs use, with a digest of everything in it that a result depends on."""

    value: Any
    sha256: str


class Task(NamedTuple):
    """A job with the digests that identify it."""

    job: Job
    code: str
    """Digest of the source code in the process that gives the job."""
    key: str


def perform(task: Task, shared: Sequence[bytes]) -> bytes | TouchdError:
    """Run a job on one thread, and return its pickled result, or its error with the job's traceback as a note.

    `shared` holds the job's shared objects, pickled. An error that is not touchd's becomes a JobError, since others may
    not be picklable.
    """
    job = task.job
    try:
        if code_digest(job.function.__module__) != task.code:
            raise JobError(
                "a worker has another source code than the process that gave it the job", job.name,
                "use the same version of touchd everywhere, and start workers again after a change",
            )  # fmt: skip
        # What a job gets and gives is pickled even in this process, so that it is the same in any other.
        arguments = pickle.loads(pickle.dumps(dict(job.arguments)))  # noqa: S301 - written in this very line
        arguments |= {name: pickle.loads(data) for name, data in zip(job.shared, shared, strict=True)}  # noqa: S301 - likewise
        with _one_thread():
            result = job.function(**arguments)
        return pickle.dumps(result, protocol=pickle.HIGHEST_PROTOCOL)
    except (Exception, SystemExit) as error:
        fix = "run again with --debug, which shows where it was raised"
        own = error if isinstance(error, TouchdError) else JobError(f"{type(error).__name__}: {error}", job.name, fix)
        own.add_note(f"in the job {job.name!r}:\n{traceback.format_exc()}")
        return own


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep linear algebra and PyTorch on one thread: another number of threads rounds sums differently."""
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError:
        limited: Any = nullcontext()
    else:
        limited = threadpool_limits(1)  # of the libraries that are loaded; others read the environment
    before = {name: os.environ[name] for name in ONE_THREAD if name in os.environ}
    os.environ.update(ONE_THREAD)
    torch = sys.modules.get("torch")
    threads = torch.get_num_threads() if torch else 1
    try:
        with limited:
            if torch:
                torch.set_num_threads(1)
            yield
    finally:
        if torch:
            torch.set_num_threads(threads)
        for name in ONE_THREAD:
            os.environ.pop(name)
        os.environ.update(before)


def digest(value: Any) -> str:
    """Return the SHA-256 of a value's canonical form, in hexadecimal digits.

    Knows None, booleans, numbers, text, bytes, sequences, mappings, numpy's arrays and scalars, dataclasses and
    pydantic models. A list and a tuple of the same values are the same. Raises TypeError for any other type, since
    nothing tells what its value is.
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
