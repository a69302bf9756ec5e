"""Long computations as jobs: run on all cores or on a Dask cluster, and kept as they end, so that a killed run goes on.

A job is a function, its arguments, and the names of large objects that many jobs share. Its result may depend on these
and on the source code only: not on other jobs, the order, the place or the number of workers. Every job runs on one
thread, and all it gets and gives is pickled, also where it runs in this process; so results agree to the bit wherever
processors and libraries are alike.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from touchd.jobs.identity import code_digest
from touchd.jobs.job import Failure, Job, Parcel, Shared, Task, key_of, one_thread, perform
from touchd.jobs.store import Store

Progress = Callable[[str, int, int], object]
"""Called with a job's name when it has ended or was found on disk, how many have, and how many there are."""

Runner = Callable[[Iterator[Task], Mapping[str, Parcel]], Iterator[tuple[str, bytes | Failure]]]
"""Yields names and pickled results in the order in which jobs end; takes a task when a worker is free."""


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
        No two with the same name.
    workers : int, optional
        Processes on this computer; by default one a core. With 1 the jobs run in this process. Not used with `dask`.
    dask : str, optional
        Address of a Dask scheduler, such as "tcp://127.0.0.1:8786", whose workers shall do the work.
    cache : Path, optional
        A folder for results; none are kept without it. A result found there is not computed again if the function,
        its arguments, what it shares, the source code and the numeric libraries are all the same.
    shared : mapping
        Large objects by name, sent to each worker once. A `Shared` brings its own digest, another object is digested
        here. Jobs must not change them.
    progress : callable, optional

    Raises
    ------
    TouchdError
        A job's own, as it is. Jobs that ran beside it are finished first, and kept.
    JobError
        When a job failed in another way, or its worker died.
    ClusterError
        When the cluster cannot be reached or used.
    """
    if len({job.name for job in jobs}) < len(jobs):
        raise ValueError("two jobs have the same name")
    objects = {name: value if isinstance(value, Shared) else Shared.of(value) for name, value in shared.items()}
    digests = {name: each.sha256 for name, each in objects.items()}
    store = Store(cache) if cache is not None else None
    results: dict[str, Any] = {}

    def take(name: str, data: bytes) -> None:
        results[name] = pickle.loads(data)  # noqa: S301 - from a worker, or from the user's own folder with its digest
        if progress is not None:
            progress(name, len(results), len(jobs))

    tasks: list[Task] = []
    for job in jobs:
        code = code_digest(job.function.__module__)
        key = key_of(job, code, {name: digests[name] for name in job.shared})
        data = store.load(key) if store else None
        if data is None:
            tasks.append(Task(job, code, key))
        else:
            take(job.name, data)
    if tasks:
        used = {name for task in tasks for name in task.job.shared}
        parcels = {name: Parcel.of(each) for name, each in objects.items() if name in used}
        _work(tasks, parcels, _runner(workers, dask, len(tasks)), store, take)
    return {job.name: results[job.name] for job in jobs}


def _work(
    tasks: Sequence[Task],
    parcels: Mapping[str, Parcel],
    runner: Runner,
    store: Store | None,
    take: Callable[[str, bytes], None],
) -> None:
    """Run tasks and keep each result as it comes; after a failure begin no more, and raise it at the end."""
    keys = {task.job.name: task.key for task in tasks}
    failures: list[tuple[str, Failure]] = []

    def until_one_fails() -> Iterator[Task]:
        for task in tasks:
            if failures:
                return
            yield task

    outcomes = runner(until_one_fails(), parcels)
    with closing(outcomes):  # type: ignore[type-var]  # every runner is a generator
        for name, outcome in outcomes:
            if isinstance(outcome, Failure):
                failures.append((name, outcome))
                continue
            if store:
                store.save(keys[name], outcome)
            take(name, outcome)
    for name, failure in failures[:1]:
        raise failure.explained(name)


def _runner(workers: int | None, dask: str | None, tasks: int) -> Runner:
    """Choose who works."""
    if dask is not None:
        from touchd.jobs.cluster import on_cluster

        return partial(on_cluster, dask)
    if workers is None:
        from touchd.jobs.local import cores

        workers = cores()
    if workers < 1:
        raise ValueError(f"{workers} workers")
    workers = min(workers, tasks)
    if workers == 1:
        return _here
    from touchd.jobs.local import on_cores

    return partial(on_cores, workers)


def _here(tasks: Iterator[Task], parcels: Mapping[str, Parcel]) -> Iterator[tuple[str, bytes | Failure]]:
    """Run tasks in this process, one after the other."""
    loaded = {name: parcel.load() for name, parcel in parcels.items()}
    for task in tasks:
        with one_thread():
            outcome = perform(task, {name: loaded[name] for name in task.job.shared})
        yield task.job.name, outcome


__all__ = ["Job", "Progress", "Shared", "run"]
