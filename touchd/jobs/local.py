"""Jobs on the cores of this computer: a process for each, through loky."""

from __future__ import annotations

import os
import pickle
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from functools import cache
from itertools import islice
from queue import SimpleQueue
from typing import Any, ParamSpec

from touchd.errors import JobError
from touchd.jobs.job import Failure, Parcel, Task, one_thread, perform

ORPHAN_CHECK_S = 0.5
P = ParamSpec("P")


def cores() -> int:
    """How many processes can work at once here; 1 where loky is not installed, since then there is but this one."""
    try:
        import loky
    except ModuleNotFoundError:
        return 1
    count: int = loky.cpu_count()
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
    from loky import BrokenProcessPool, ProcessPoolExecutor

    under_way: set[str] = set()
    ended: SimpleQueue[Future[tuple[str, bytes | Failure]]] = SimpleQueue()
    with ExitStack() as stack:
        # Files without a name, reached through this process: they vanish with it.
        paths = {}
        for name, parcel in parcels.items():
            file = stack.enter_context(tempfile.TemporaryFile())
            file.write(parcel.data)
            file.flush()
            paths[name] = f"/proc/{os.getpid()}/fd/{file.fileno()}"

        pool = ProcessPoolExecutor(workers)
        stack.callback(_uninterrupted(pool.shutdown), wait=True, kill_workers=True)

        def begin(count: int) -> None:
            for task in islice(tasks, count):
                under_way.add(task.job.name)
                used = {name: paths[name] for name in task.job.shared}
                pool.submit(_in_worker, os.getpid(), task, used).add_done_callback(ended.put)

        try:
            # Processes that ignore Ctrl-C, which is this one's affair; it does too, for the tenth of a second it takes.
            # To block the signal instead would lose none, but loky unblocks it before it starts its workers.
            with _interrupted(signal.SIG_IGN):
                begin(workers)
            while under_way:
                name, outcome = ended.get().result()
                under_way.remove(name)
                yield name, outcome
                _uninterrupted(begin)(1)
        except BrokenProcessPool as error:
            raise JobError(
                "a worker process was killed, perhaps since memory ran out", ", ".join(sorted(under_way)),
                "run again, with fewer jobs at a time; what is finished is kept",
            ) from error  # fmt: skip


@contextmanager
def _interrupted(handler: Callable[[int, object], object] | signal.Handlers) -> Iterator[None]:
    """Have Ctrl-C do that; it comes to the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _uninterrupted(call: Callable[P, object]) -> Callable[P, None]:
    """Let Ctrl-C wait until a call has returned.

    Where it came while the pool's own locks were taken they stayed so, and the pool's end waited for them for ever.
    """

    def whole(*args: P.args, **kwargs: P.kwargs) -> None:
        came: list[int] = []
        try:
            with _interrupted(lambda number, _: came.append(number)):
                call(*args, **kwargs)
        finally:
            for number in came[:1]:
                signal.raise_signal(number)

    return whole


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
    """Leave Ctrl-C to the parent process also in a worker that loky started later, and end when the parent has gone.

    Nobody would take the results.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(ORPHAN_CHECK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
