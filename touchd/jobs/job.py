"""A job, its arguments and shared objects as they travel to a worker, and how a worker runs it."""

from __future__ import annotations

import os
import pickle
import sys
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from touchd.errors import JobError, TouchdError
from touchd.jobs.identity import code_digest, digest, libraries

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment variables that libraries of linear algebra read when they are loaded."""


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


def key_of(job: Job, code: str, shared: Mapping[str, str]) -> str:
    """Digest everything that a job's result depends on.

    Parameters
    ----------
    job : Job
        Its name does not matter.
    code : str
        `code_digest` of the function's module.
    shared : mapping
        Digests of the job's shared objects by name.
    """
    function = f"{job.function.__module__}.{job.function.__qualname__}"
    return digest([function, job.arguments, shared, code, libraries()])


@dataclass(frozen=True, slots=True)
class Shared:
    """A large object that many jobs use, with a digest of everything in it that a result depends on."""

    value: Any
    sha256: str

    @classmethod
    def of(cls, value: Any) -> Shared:
        """Compute the digest; raises TypeError if the object has parts that cannot be digested."""
        return cls(value, digest(value))


class Parcel:
    """A shared object as it travels: pickled once, unpickled by the first job of a process that needs it.

    Dask moves the bytes: its own way of moving arrays keeps neither alignment nor layout.
    """

    def __init__(self, data: bytes) -> None:
        self.data = data

    def __reduce__(self) -> tuple[type[Parcel], tuple[bytes]]:
        return Parcel, (self.data,)

    @classmethod
    def of(cls, value: Any) -> Parcel:
        """Pack an object."""
        return cls(pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL))

    @cached_property
    def value(self) -> Any:
        """A copy of the packed object."""
        return pickle.loads(self.data)  # noqa: S301 - packed by the process that gave the job


class Task(NamedTuple):
    """A job with the digests that identify it."""

    job: Job
    code: str
    """Digest of the source code in the process that gives the job."""
    key: str


class Failure(NamedTuple):
    """Why a job has no result: its own TouchdError, or a JobError for an exception that may not be picklable."""

    error: TouchdError
    note: str = ""
    """The job's name and the traceback, shown with --debug."""

    @classmethod
    def of(cls, error: BaseException, name: str) -> Failure:
        """Describe the exception being handled, of the job of this name."""
        fix = "run again with --debug, which shows where it was raised"
        own = error if isinstance(error, TouchdError) else JobError(f"{type(error).__name__}: {error}", name, fix)
        return cls(own, f"in the job {name!r}:\n{traceback.format_exc()}")


class Outcome(NamedTuple):
    """How a job ended."""

    name: str
    result: bytes | Failure
    """The pickled result."""


Outcomes = Generator[Outcome, None, None]
"""Outcomes in the order in which jobs end. After a failure no more jobs begin."""


def perform(task: Task, parcels: Sequence[Parcel]) -> bytes | Failure:
    """Run a job on one thread, and return its pickled result; `parcels` are the job's shared objects."""
    job = task.job
    try:
        if code_digest(job.function.__module__) != task.code:
            raise JobError(
                "a worker has another source code than the process that gave it the job", job.name,
                "use the same version of touchd everywhere, and start workers again after a change",
            )  # fmt: skip
        arguments = pickle.loads(pickle.dumps(dict(job.arguments)))  # noqa: S301 - written in this very line
        arguments |= {name: parcel.value for name, parcel in zip(job.shared, parcels, strict=True)}
        with _one_thread():
            result = job.function(**arguments)
        return pickle.dumps(result, protocol=pickle.HIGHEST_PROTOCOL)
    except (Exception, SystemExit) as error:
        return Failure.of(error, job.name)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep linear algebra and PyTorch on one thread: another number of threads rounds sums differently."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    torch = sys.modules.get("torch")
    torch_threads = torch.get_num_threads() if torch else 1
    os.environ.update(ONE_THREAD)
    limits = _limit_loaded()
    if torch:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if torch:
            torch.set_num_threads(torch_threads)
        if limits is not None:
            limits.restore_original_limits()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _limit_loaded() -> Any:
    """Limit the libraries that are already loaded; None without the package that can."""
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError:
        return None
    return threadpool_limits(1)
