"""Jobs on the workers of a Dask cluster that already runs."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import Any

import structlog
from distributed import Client, Future, KilledWorker

from touchd.errors import ClusterError, JobError, TouchdError
from touchd.jobs.job import AGAIN, Ended, Task, perform

log = structlog.get_logger()

CONNECT_S = 8.0
"""A scheduler must answer within this time."""
WORKERS_S = 20.0
"""A run ends when there has been no worker for this time."""
STOP_S = 3.0
"""A run that ends gives Dask this time to disconnect."""


class Cluster:
    """The workers of a scheduler, which may come and go; connected to while in the context.

    A cluster begins a job again whose worker died, until it has lost several with that job.

    Parameters
    ----------
    address : str
        Keys for TLS are those of Dask's own configuration.
    shared : mapping
        Pickled objects by name, sent to all workers once there is one.
    """

    def __init__(self, address: str, shared: Mapping[str, bytes]) -> None:
        self._address, self._shared = address, shared
        self._client: Client
        self._sent: dict[str, Future[bytes]] | None = None
        self._running: dict[object, tuple[Future[Any], str]] = {}
        self._done: SimpleQueue[Future[Any]] = SimpleQueue()
        self._seen_s = 0.0

    def __enter__(self) -> Cluster:
        quiet()
        # Dask's own limit does not cover a server that accepts a connection and then says nothing. And an interrupt
        # amid Dask's code could leave locks taken.
        found: SimpleQueue[Client | Exception] = SimpleQueue()
        threading.Thread(target=_connect, args=(self._address, found), daemon=True).start()
        client: Client | Exception = TimeoutError()
        with suppress(Empty):
            client = found.get(timeout=CONNECT_S + 1)
        if isinstance(client, Exception):
            raise ClusterError(
                f"no Dask scheduler answers ({type(client).__name__})", self._address,
                "start one with: dask scheduler; or correct the address, such as tcp://127.0.0.1:8786",
            ) from client  # fmt: skip
        self._client, self._seen_s = client, time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError, CancelledError):  # the scheduler may have gone
            self._client.close(timeout=STOP_S)

    def count(self) -> int:
        """Return how many workers there are, once they have the shared objects."""
        with self._scheduler_needed():
            workers: dict[str, int] = self._client.nthreads()
            if workers and self._sent is None:
                crowded = [worker for worker, threads in workers.items() if threads > 1]
                if crowded:
                    log.warning("jobs run one at a time in a worker: start it with --nthreads 1", workers=crowded)
                shared = dict(self._shared)
                self._sent = self._client.scatter(shared, broadcast=True, hash=False) if shared else {}
        now_s = time.monotonic()
        if workers:
            self._seen_s = now_s
        elif now_s > self._seen_s + WORKERS_S:
            raise ClusterError(f"no worker for {WORKERS_S:g} s", self._address, f"start some, and {AGAIN}")
        return len(workers)

    def begin(self, task: Task) -> None:
        """Give a task to the scheduler."""
        assert self._sent is not None  # `count` comes first
        with self._scheduler_needed():
            shared = [self._sent[name] for name in task.job.shared]
            future = self._client.submit(_on_worker, task, shared, pure=False)
        self._running[future.key] = future, task.job.name
        future.add_done_callback(self._done.put)

    def ended(self, timeout_s: float) -> Sequence[Ended]:
        """Return what has ended, after this time at most."""
        try:
            key = self._done.get(timeout=timeout_s).key
        except Empty:
            self.count()  # ends the run if the workers or the scheduler have gone
            return []
        future, name = self._running.pop(key)
        with self._scheduler_needed():
            return [_result(future, name)]

    @contextmanager
    def _scheduler_needed(self) -> Iterator[None]:
        try:
            yield
        except (OSError, CancelledError) as error:
            what = f"the scheduler has gone ({type(error).__name__})"
            raise ClusterError(what, self._address, f"start it, and {AGAIN}") from error


def quiet() -> None:
    """Silence Dask's log: what it would say, with tracebacks, is said by the errors of `touchd.jobs`."""
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _connect(address: str, found: SimpleQueue[Client | Exception]) -> None:
    try:
        found.put(Client(address, timeout=CONNECT_S, name="touchd", set_as_default=False))
    except Exception as error:  # any server may answer at an address, and break Dask's parser in its own way
        found.put(error)


def _result(future: Future[Any], name: str) -> Ended:
    """Return what a job gave, or why Dask could not run it."""
    try:
        return name, future.result()
    except (OSError, CancelledError):
        raise  # of the connection: a job's own are results
    except KilledWorker:
        killed = "its worker was killed, perhaps since memory ran out"
        return name, JobError(killed, name, f"{AGAIN}; use fewer workers at a time")
    except Exception as error:
        what = f"no worker can run the job ({type(error).__name__}: {error})"
        return name, ClusterError(what, name, "install the same versions of touchd, Python and Dask everywhere")


_one_at_a_time = threading.Lock()
"""A job owns its process: seeds and the number of threads are shared by all threads of a worker."""


def _on_worker(task: Task, shared: Sequence[bytes]) -> bytes | TouchdError:
    """Run a task in a thread of a Dask worker."""
    with _one_at_a_time:
        return perform(task, shared)
