"""Jobs on the cores of this computer: a process for each, through joblib."""

from __future__ import annotations

import os
import pickle
import signal
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any

from touchd.errors import JobError
from touchd.jobs.job import Failure, Parcel, Task, one_thread, perform

ORPHAN_CHECK_S = 0.5


def cores() -> int:
    """How many processes can work at once here; 1 where joblib is not installed, since then there is but this one."""
    try:
        import joblib
    except ModuleNotFoundError:
        return 1
    count: int = joblib.cpu_count()
    return count


def on_cores(
    workers: int, tasks: Iterator[Task], parcels: Mapping[str, Parcel]
) -> Iterator[tuple[str, bytes | Failure]]:
    """Run tasks in processes of their own; they end with this generator, or with this process whatever ends it.

    Raises
    ------
    JobError
        When a worker died.
    """
    import joblib
    from joblib.externals.loky import BrokenProcessPool, get_reusable_executor

    under_way: dict[str, None] = {}
    with ExitStack() as stack:
        # Files without a name, reached through this process: they vanish with it.
        paths = {}
        for name, parcel in parcels.items():
            file = stack.enter_context(tempfile.TemporaryFile())
            file.write(parcel.data)
            file.flush()
            paths[name] = f"/proc/{os.getpid()}/fd/{file.fileno()}"

        def calls() -> Iterator[Any]:
            for task in tasks:
                under_way[task.job.name] = None
                yield joblib.delayed(_in_worker)(os.getpid(), task, {name: paths[name] for name in task.job.shared})

        parallel = joblib.Parallel(
            n_jobs=workers, backend="loky", return_as="generator_unordered", pre_dispatch="n_jobs", batch_size=1,
            # What jobs get must not depend on how many of them there are: no memory maps for large arguments.
            max_nbytes=None,
        )  # fmt: skip
        # joblib keeps its processes for later; here they end with the work.
        stack.callback(lambda: get_reusable_executor().shutdown(wait=True, kill_workers=True))
        try:
            with _interrupt_for_parent():
                outcomes = parallel(calls())
            for name, outcome in outcomes:
                del under_way[name]
                yield name, outcome
        except BrokenProcessPool as error:
            raise JobError(
                "a worker process was killed, perhaps since memory ran out", ", ".join(under_way),
                "run again, with fewer jobs at a time; what is finished is kept",
            ) from error  # fmt: skip


@contextmanager
def _interrupt_for_parent() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, which is this one's affair; it does too, for the tenth of a second it takes.

    To block the signal instead would lose none, but joblib unblocks it before it starts its workers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _in_worker(parent: int, task: Task, paths: Mapping[str, str]) -> tuple[str, bytes | Failure]:
    """Do a task in a worker process."""
    _settle(parent)
    with one_thread():
        try:
            shared = {name: _load(path) for name, path in paths.items()}
        except Exception as error:
            return task.job.name, Failure.of(error)
        return task.job.name, perform(task, shared)


@cache
def _load(path: str) -> Any:
    """Load a shared object, once a worker."""
    with open(path, "rb") as file:
        return pickle.load(file)  # noqa: S301 - written by this process's parent


@cache
def _settle(parent: int) -> None:
    """Leave Ctrl-C to the parent process also in a worker that joblib started later, and end when the parent has gone.

    Nobody would take the results.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(ORPHAN_CHECK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
