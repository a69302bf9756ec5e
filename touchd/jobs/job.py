"""A job, what it takes with it to a worker, and how a worker does it."""

from __future__ import annotations

import os
import pickle
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

from touchd.errors import JobError, TouchdError
from touchd.jobs.identity import code_digest, digest, libraries

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What libraries of linear algebra read when they are loaded."""


@dataclass(frozen=True, slots=True)
class Job:
    """One part of a long computation."""

    name: str
    """Unique in a run, for people."""
    function: Callable[..., Any]
    """Of a module, so that workers can import it."""
    arguments: Mapping[str, Any]
    """By name; small, and of types that `touchd.jobs.identity.digest` knows."""
    shared: tuple[str, ...] = ()
    """Names of shared objects, which the function gets as further arguments of these names."""

    def __post_init__(self) -> None:
        module, name = self.function.__module__, self.function.__qualname__
        if module == "__main__" or getattr(sys.modules.get(module), name, None) is not self.function:
            raise TypeError(f"a job's function must be one of a module that can be imported, not {module}.{name}")


def key_of(job: Job, code: str, shared: Mapping[str, str]) -> str:
    """Digest all that a job's result depends on.

    Parameters
    ----------
    job : Job
        Its name does not matter.
    code : str
        `code_digest` of the function's module.
    shared : mapping
        Digests of the shared objects it gets, by name.
    """
    function = f"{job.function.__module__}.{job.function.__qualname__}"
    return digest([function, job.arguments, shared, code, libraries()])


@dataclass(frozen=True, slots=True)
class Shared:
    """A large object that many jobs use, with a digest of all of it that a result depends on."""

    value: Any
    sha256: str

    @classmethod
    def of(cls, value: Any) -> Shared:
        """Compute the digest; a TypeError says that the object has parts which cannot be digested."""
        return cls(value, digest(value))


class Parcel(NamedTuple):
    """A shared object as it travels: pickled once."""

    data: bytes

    @classmethod
    def of(cls, shared: Shared) -> Parcel:
        """Pack a shared object."""
        return cls(pickle.dumps(shared.value, protocol=pickle.HIGHEST_PROTOCOL))

    def load(self) -> Any:
        """Unpack it. What jobs get is never the caller's own object."""
        return pickle.loads(self.data)  # noqa: S301 - packed by the process that gave the job


class Task(NamedTuple):
    """A job with what identifies it."""

    job: Job
    code: str
    """Digest of the source code that the caller means."""
    key: str


class Failure(NamedTuple):
    """Why a job has no result; can always be pickled, other than many an exception."""

    what: str
    error: TouchdError | None
    traceback: str

    @classmethod
    def of(cls, error: BaseException) -> Failure:
        """Take down the exception being handled."""
        own = error if isinstance(error, TouchdError) else None
        return cls(f"{type(error).__name__}: {error}", own, traceback.format_exc())

    def explained(self, name: str) -> TouchdError:
        """Return the error to be raised by the process that gave the job."""
        error = self.error or JobError(self.what, name, "run again with --debug, which shows where it was raised")
        error.add_note(f"in the job {name!r}:\n{self.traceback}")
        return error


def perform(task: Task, shared: Mapping[str, Any]) -> bytes | Failure:
    """Do a job, and return its pickled result."""
    job = task.job
    try:
        if code_digest(job.function.__module__) != task.code:
            raise JobError(
                "a worker has another source code than the process that gave it the job", job.name,
                "use the same version of touchd everywhere, and start workers again after a change",
            )  # fmt: skip
        arguments = pickle.loads(pickle.dumps(dict(job.arguments)))  # noqa: S301 - written in this very line
        return pickle.dumps(job.function(**arguments, **shared), protocol=pickle.HIGHEST_PROTOCOL)
    except (Exception, SystemExit) as error:
        return Failure.of(error)


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep linear algebra and PyTorch on one thread: with another number, sums are rounded differently."""
    before = {name: os.environ.get(name) for name in THREADS}
    torch = sys.modules.get("torch")
    torch_threads = torch.get_num_threads() if torch else 1
    os.environ.update(dict.fromkeys(THREADS, "1"))
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
    """Limit the libraries that are loaded already; None where the package for it is not installed."""
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError:
        return None
    return threadpool_limits(1)
