"""Jobs on a Dask cluster that runs already."""

from __future__ import annotations

import asyncio
import logging
import pickle
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import structlog

from touchd.errors import ClusterError, JobError
from touchd.jobs.job import Failure, Parcel, Task, one_thread, perform

if TYPE_CHECKING:
    from distributed import Client, Future

log = structlog.get_logger()

CONNECT_S = 8.0
"""How long a scheduler may take to answer."""
WORKERS_S = 20.0
"""How long there may be no worker."""
CHECK_S = 2.0
"""How often to look whether there still is one, while nothing ends."""
AGAIN = "run again when it is there; what is finished is kept"


def on_cluster(
    address: str, tasks: Iterator[Task], parcels: Mapping[str, Parcel]
) -> Iterator[tuple[str, bytes | Failure]]:
    """Run tasks on the workers of a cluster, as many at a time as there are worker processes.

    Workers may come and go: Dask begins a job again whose worker died, until it has lost several with it.

    Raises
    ------
    ClusterError
        When no scheduler answers at the address, it has no workers, or it goes away.
    """
    from distributed import CancelledError, wait

    with _connected(address) as client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_S)
            crowded = [worker for worker, threads in client.nthreads().items() if threads > 1]
            if crowded:
                log.warning("jobs run one at a time in a worker: start it with --nthreads 1", workers=crowded)
            boxes = {name: _Box(parcel) for name, parcel in parcels.items()}
            sent: dict[str, Any] = client.scatter(boxes, broadcast=True, hash=False) if boxes else {}
            running: dict[Future[Any], str] = {}
            without_s = 0.0
            while True:
                workers = len(client.nthreads())
                # Jobs are given out one by one: those not begun when one fails are not begun at all.
                for task in _first(workers - len(running), tasks):
                    names = list(task.job.shared)
                    future = client.submit(_on_worker, task, names, [sent[name] for name in names], pure=False)
                    running[future] = task.job.name
                if not running:
                    return
                without_s = 0.0 if workers else without_s + CHECK_S
                if without_s > WORKERS_S:
                    raise ClusterError(
                        "all workers have gone", address, "start some, and run again; what is finished is kept"
                    )
                try:
                    done = wait(list(running), timeout=CHECK_S, return_when="FIRST_COMPLETED").done
                except TimeoutError:
                    continue
                for future in done:
                    yield running[future], _outcome(future, running.pop(future))
        except TimeoutError as error:
            raise ClusterError("the cluster has no workers", address, "start some: dask worker ADDRESS") from error
        except (OSError, CancelledError) as error:
            raise ClusterError(f"the cluster has gone: {type(error).__name__}", address, AGAIN) from error


@contextmanager
def _connected(address: str) -> Iterator[Client]:
    """Connect to a scheduler, and leave it at the end with nothing more to do for us."""
    from distributed import Client

    # What it would log, with tracebacks, is said by the errors raised here.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        # A client that does not get through leaves threads behind; so another connection tries first.
        asyncio.run(_knock(address))
        client = Client(address, timeout=CONNECT_S, name="touchd")
    except Exception as error:  # anything at all may answer at an address, and break a parser in its own way
        raise ClusterError(
            f"no Dask scheduler answers ({type(error).__name__})", address,
            "start one with: dask scheduler; or correct the address, such as tcp://127.0.0.1:8786",
        ) from error  # fmt: skip
    try:
        yield client
    finally:
        client.close(timeout=CONNECT_S)


async def _knock(address: str) -> None:
    """Connect and go; keys for TLS are those of Dask's own configuration."""
    from distributed.comm.core import connect
    from distributed.security import Security

    # Dask's own limit does not cover a server that accepts, and then waits to be spoken to in another language.
    async with asyncio.timeout(CONNECT_S + 1):
        comm = await connect(address, timeout=CONNECT_S, **Security().get_connection_args("client"))
        comm.abort()


def _first(count: int, tasks: Iterator[Task]) -> Iterator[Task]:
    """Take at most so many tasks; itertools.islice would refuse a negative number."""
    for _ in range(count):
        for task in tasks:
            yield task
            break


def _outcome(future: Future[Any], name: str) -> bytes | Failure:
    """Return what a job gave, or why Dask could not have it done."""
    from distributed import KilledWorker

    if future.status != "error":
        outcome: bytes | Failure = future.result()
        return outcome
    error = future.exception()
    if isinstance(error, KilledWorker):
        explained = JobError("each worker that began it died, perhaps since memory ran out", name, AGAIN)
    else:
        explained = ClusterError(
            f"no worker can take the job ({type(error).__name__}: {error})", name,
            "install the same versions of touchd, Python and Dask for scheduler and workers",
        )  # fmt: skip
    return Failure(str(error), explained, "")


class _Box:
    """A shared object in a worker's memory: unpacked when a job first needs it, gone when Dask forgets it.

    Bytes and not the object travel through Dask, whose own way of moving arrays keeps neither alignment nor layout.
    """

    def __init__(self, parcel: Parcel) -> None:
        self._parcel = parcel
        self._loaded: list[Any] = []

    def __reduce__(self) -> tuple[type[_Box], tuple[Parcel]]:
        return _Box, (self._parcel,)

    def load(self) -> Any:
        """Return the object."""
        if not self._loaded:
            self._loaded.append(self._parcel.load())
        return self._loaded[0]


_one_at_a_time = threading.Lock()
"""A job owns its process: seeds and the number of threads are one for all threads of a worker."""


def _on_worker(task: Task, names: Sequence[str], boxes: Sequence[_Box]) -> bytes | Failure:
    """Do a task in a thread of a Dask worker."""
    with _one_at_a_time, one_thread():
        try:
            shared = {name: box.load() for name, box in zip(names, boxes, strict=True)}
        except (ImportError, AttributeError, pickle.UnpicklingError, MemoryError) as error:
            return Failure.of(error)
        return perform(task, shared)
