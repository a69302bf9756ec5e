"""Long computations as jobs: run on this computer's cores or a Dask cluster, kept as they end, and resumed.

A job is a function, its arguments, and the names of large objects that many jobs share. Its result depends on these,
the source code and the libraries only: not on other jobs, the order, the place or the number of workers. Every job runs
on one thread, and what it gets and gives is pickled even in this process; so results agree to the bit on processors of
one kind.
"""

from __future__ import annotations

import asyncio
import pickle
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from types import MappingProxyType
from typing import Any

from touchd.errors import TouchdError
from touchd.jobs.job import Ended, Job, Shared, Task, code_digest, digest, perform
from touchd.jobs.store import Store

Progress = Callable[[str, int, int], object]
"""Called when a job has ended or was found on disk: its name, how many jobs have ended, and how many there are."""
CHECK_S = 1.0
"""A wait is interrupted this often: a signal that comes just before it does not end it."""
STOP_S = 3.0
"""A run that ends early gives Dask this time to disconnect."""


def run(
    jobs: Sequence[Job],
    *,
    workers: int | None = None,
    dask: str | None = None,
    cache: Path | None = None,
    shared: Mapping[str, Shared] = MappingProxyType({}),
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run jobs, whose names are unique, and return their results by name, in the order of `jobs`.

    `workers` is the number of processes on this computer, by default one per core; with 1, jobs run in this process.
    `dask` is the address of a Dask scheduler, such as "tcp://127.0.0.1:8786", whose workers run the jobs instead.
    `cache` is the folder that keeps results, by default none: a kept one is used if function, arguments, shared
    objects, source code and libraries are the same. `shared` are large objects by name, sent to each worker once.
    Raises a job's own TouchdError, after those that run beside it have finished and are kept; JobError if a job raises
    another exception, or its worker dies; ClusterError if the cluster cannot be reached or used; OutputError if another
    user could have written the results in `cache`.
    """
    if len({job.name for job in jobs}) < len(jobs):
        raise ValueError("two jobs have the same name")
    digests = {name: each.sha256 for name, each in shared.items()}
    store = Store(cache) if cache is not None else None
    results: dict[str, Any] = {}

    def take(name: str, data: bytes) -> None:
        results[name] = pickle.loads(data)  # noqa: S301 - from our worker, or a file that only this user can write
        if progress is not None:
            progress(name, len(results), len(jobs))

    tasks: dict[str, Task] = {}
    for job in jobs:
        code = code_digest(job.function.__module__)
        key = job.key(code, digests)
        data = store.load(key) if store else None
        if data is None:
            tasks[job.name] = Task(job, code, key)
        else:
            take(job.name, data)

    used = {name for task in tasks.values() for name in task.job.shared}
    pickled = {name: pickle.dumps(shared[name].value, protocol=pickle.HIGHEST_PROTOCOL) for name in used}
    failures: list[TouchdError] = []
    with closing(_ended(list(tasks.values()), pickled, workers, dask)) as ended:
        for name, result in ended:
            if isinstance(result, TouchdError):
                failures.append(result)
                continue
            if store:
                store.save(tasks[name].key, result)
            take(name, result)
    if failures:
        raise failures[0]
    return {job.name: results[job.name] for job in jobs}


def _ended(
    tasks: Sequence[Task], shared: Mapping[str, bytes], workers: int | None, dask: str | None
) -> Generator[Ended]:
    """Run tasks here, on worker processes or on a cluster; yield each that has ended. After a failure none begins."""
    workers = min(workers or _cores(), len(tasks))
    if workers > 1 or (tasks and dask is not None):
        yield from _on_dask(tasks, shared, dask or workers)
        return
    for task in tasks:
        result = perform(task, [shared[name] for name in task.job.shared])
        yield task.job.name, result
        if isinstance(result, TouchdError):
            return


def _on_dask(tasks: Sequence[Task], shared: Mapping[str, bytes], where: str | int) -> Generator[Ended]:
    """Run tasks on the workers of the scheduler at an address, or on a number of worker processes of this computer.

    Dask is imported and runs in a thread of its own; the caller's thread only waits for what has ended, and for Ctrl-C
    as for one of them. So an interrupt never comes amid Dask's code, where it could leave locks taken, and is never
    lost. Raises ClusterError if no scheduler answers at the address, it has no workers, or it goes away.
    """
    ended: SimpleQueue[Ended | BaseException | None] = SimpleQueue()
    stops: SimpleQueue[Callable[[], object]] = SimpleQueue()

    async def work() -> None:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None
        stops.put(lambda: loop.call_soon_threadsafe(task.cancel))
        from touchd.jobs.cluster import run_on

        await run_on(where, tasks, shared, ended.put)

    def drive() -> None:
        try:
            asyncio.run(work())
            ended.put(None)
        except BaseException as error:  # raised where it is awaited
            ended.put(error)

    thread = threading.Thread(target=drive, name="touchd-dask", daemon=True)
    with _interrupts_put(ended.put):
        thread.start()
        try:
            while True:
                try:
                    each = ended.get(timeout=CHECK_S)
                except Empty:
                    continue
                if each is None:
                    return
                if isinstance(each, BaseException):
                    raise each
                yield each
        finally:
            with suppress(Empty, RuntimeError):  # never begun, or already ended
                stops.get(timeout=STOP_S)()
                thread.join(STOP_S)


@contextmanager
def _interrupts_put(put: Callable[[KeyboardInterrupt], object]) -> Iterator[None]:
    """Put a KeyboardInterrupt on Ctrl-C instead of raising it wherever the main thread is.

    In a destructor or a callback, as of an import, Python prints a raised one and goes on.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is not signal.default_int_handler:
        yield
        return
    came = []

    def handle(_number: int, _frame: object) -> None:
        came.append(KeyboardInterrupt())
        put(came[-1])

    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:  # after the last job
        raise came[0]


def _cores() -> int:
    """Return the number of cores this process may use; 1 without Dask, since jobs then run in this process."""
    try:
        from dask.system import CPU_COUNT
    except ModuleNotFoundError:
        return 1
    return CPU_COUNT


__all__ = ["Job", "Progress", "Shared", "digest", "run"]
