"""Long computations as jobs: run on this computer's cores or a Dask cluster, kept as they end, and resumed.

A job is a function, its arguments, and the names of large objects that many jobs share. Its result depends on these,
the source code and the libraries only: not on other jobs, the order, the place or the number of workers. Every job runs
on one thread, and its arguments and result are pickled even in this process; so results agree to the bit on processors
of one kind.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from types import MappingProxyType
from typing import Any

from touchd.jobs.engine import on_dask
from touchd.jobs.identity import code_digest, digest
from touchd.jobs.job import Failure, Job, Outcome, Outcomes, Parcel, Shared, Task, key_of, perform
from touchd.jobs.store import Store

Progress = Callable[[str, int, int], object]
"""Called when a job has ended or was found on disk: its name, how many jobs have ended, and how many there are."""


def run(
    jobs: Sequence[Job],
    *,
    workers: int | None = None,
    dask: str | None = None,
    cache: Path | None = None,
    shared: Mapping[str, Any] = MappingProxyType({}),
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run jobs, and return their results by name, in the order of `jobs`.

    Parameters
    ----------
    jobs : sequence of Job
        Names must be unique.
    workers : int, optional
        Worker processes on this computer; by default one per core. With 1, jobs run in this process.
    dask : str, optional
        Address of a Dask scheduler, such as "tcp://127.0.0.1:8786", whose workers run the jobs.
    cache : Path, optional
        Folder that keeps results; without it none are kept. A kept result is used if function, arguments, shared
        objects, source code and libraries are the same.
    shared : mapping
        Large objects by name, sent to each worker once. A `Shared` brings its own digest; of others it is computed.
        Jobs must not change them.
    progress : callable, optional

    Raises
    ------
    TouchdError
        A job's own. Jobs that run beside it finish first, and are kept.
    JobError
        When a job raises another exception, or its worker dies.
    ClusterError
        When the cluster cannot be reached or used.
    OutputError
        When another user could have written the results in `cache`.
    """
    if len({job.name for job in jobs}) < len(jobs):
        raise ValueError("two jobs have the same name")
    if workers is not None and workers < 1:
        raise ValueError(f"{workers} workers")
    objects = {name: value if isinstance(value, Shared) else Shared.of(value) for name, value in shared.items()}
    store = Store(cache) if cache is not None else None
    results: dict[str, Any] = {}

    def take(name: str, data: bytes) -> None:
        results[name] = pickle.loads(data)  # noqa: S301 - from our worker, or a file that only this user can write
        if progress is not None:
            progress(name, len(results), len(jobs))

    tasks: dict[str, Task] = {}
    for job in jobs:
        code = code_digest(job.function.__module__)
        key = key_of(job, code, {name: objects[name].sha256 for name in job.shared})
        data = store.load(key) if store else None
        if data is None:
            tasks[job.name] = Task(job, code, key)
        else:
            take(job.name, data)

    used = {name for task in tasks.values() for name in task.job.shared}
    parcels = {name: Parcel.of(objects[name].value) for name in used}
    failures: list[Failure] = []
    with closing(_outcomes(list(tasks.values()), parcels, workers, dask)) as outcomes:
        for name, result in outcomes:
            if isinstance(result, Failure):
                failures.append(result)
                continue
            if store:
                store.save(tasks[name].key, result)
            take(name, result)
    for failure in failures[:1]:
        failure.error.add_note(failure.note)
        raise failure.error
    return {job.name: results[job.name] for job in jobs}


def _outcomes(tasks: Sequence[Task], parcels: Mapping[str, Parcel], workers: int | None, dask: str | None) -> Outcomes:
    """Run tasks here, on worker processes or on a cluster."""
    workers = min(workers or _cores(), len(tasks))
    if not tasks or (dask is None and workers == 1):
        return _here(tasks, parcels)
    return on_dask(tasks, parcels, dask or workers)


def _cores() -> int:
    """Return the number of cores this process may use; 1 without Dask, since jobs then run in this process."""
    try:
        from dask.system import CPU_COUNT
    except ModuleNotFoundError:
        return 1
    return CPU_COUNT


def _here(tasks: Sequence[Task], parcels: Mapping[str, Parcel]) -> Outcomes:
    """Run tasks in this process, one after the other, until one fails."""
    for task in tasks:
        result = perform(task, [parcels[name] for name in task.job.shared])
        yield Outcome(task.job.name, result)
        if isinstance(result, Failure):
            return


__all__ = ["Job", "Progress", "Shared", "digest", "run"]
