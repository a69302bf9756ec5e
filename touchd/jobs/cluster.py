"""Jobs on the workers of a Dask scheduler: of a cluster that already runs, or of this computer's own."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import asynccontextmanager
from typing import Any

import structlog
from distributed import Client, Future, KilledWorker

from touchd.errors import ClusterError, JobError, TouchdError
from touchd.jobs.job import Ended, Task, perform
from touchd.jobs.local import connected_here, quiet

log = structlog.get_logger()

CONNECT_S = 8.0
"""A scheduler must answer within this time."""
WORKERS_S = 20.0
"""A run ends when there has been no worker for this time."""
CHECK_S, START_CHECK_S = 1.0, 0.1
"""Workers are counted this often while jobs run, and while none runs."""
AGAIN = "run again; what is finished is kept"


async def run_on(
    where: str | int, tasks: Sequence[Task], shared: Mapping[str, bytes], put: Callable[[Ended], object]
) -> None:
    """Run tasks on the scheduler at an address or on worker processes of this computer, and put each that has ended."""
    async with _connected(where) if isinstance(where, str) else connected_here(where) as client:
        await _run(client, where if isinstance(where, str) else "this computer", tasks, shared, put)


@asynccontextmanager
async def _connected(address: str) -> AsyncIterator[Client]:
    """Connect to a scheduler; keys for TLS are those of Dask's own configuration."""
    quiet()
    client = None
    try:
        client = Client(address, asynchronous=True, timeout=CONNECT_S, name="touchd", set_as_default=False)
        # Dask's own limit does not cover a server that accepts a connection and then says nothing.
        async with asyncio.timeout(CONNECT_S + 1):
            await client
    except Exception as error:  # any server may answer at an address, and break Dask's parser in its own way
        if client is not None:
            await client._close(fast=True)  # or its destructor would complain
        raise ClusterError(
            f"no Dask scheduler answers ({type(error).__name__})", address,
            "start one with: dask scheduler; or correct the address, such as tcp://127.0.0.1:8786",
        ) from error  # fmt: skip
    async with client:
        yield client


async def _run(
    client: Client, address: str, tasks: Sequence[Task], shared: Mapping[str, bytes], put: Callable[[Ended], object]
) -> None:
    """Run as many tasks at a time as there are workers; those that have not begun when one fails never begin.

    Workers may come and go. A cluster begins a job again whose worker died, until it has lost several with that job.
    """
    waiting, running, failed = deque(tasks), set[asyncio.Task[Ended]](), False
    sent: dict[str, Future[bytes]] | None = None
    loop = asyncio.get_running_loop()
    seen_s = loop.time()
    try:
        while running or (waiting and not failed):
            workers = await client.nthreads()
            if workers:
                seen_s = loop.time()
            elif loop.time() > seen_s + WORKERS_S:
                raise ClusterError(f"no worker for {WORKERS_S:g} s", address, f"start some, and {AGAIN}")
            if workers and sent is None:
                crowded = [worker for worker, threads in workers.items() if threads > 1]
                if crowded:
                    log.warning("jobs run one at a time in a worker: start it with --nthreads 1", workers=crowded)
                sent = await client.scatter(dict(shared), broadcast=True, hash=False) if shared else {}
            while sent is not None and waiting and not failed and len(running) < len(workers):
                task = waiting.popleft()
                future = client.submit(_on_worker, task, [sent[name] for name in task.job.shared], pure=False)
                running.add(asyncio.create_task(_result(future, task.job.name)))
            if not running:
                await asyncio.sleep(START_CHECK_S)
                continue
            done, running = await asyncio.wait(running, timeout=CHECK_S, return_when=asyncio.FIRST_COMPLETED)
            for each in done:
                failed |= isinstance(each.result()[1], TouchdError)
                put(each.result())
    except (OSError, CancelledError) as error:
        what = f"the scheduler has gone ({type(error).__name__})"
        raise ClusterError(what, address, f"start it, and {AGAIN}") from error
    finally:
        for each in running:
            each.cancel()
        await asyncio.gather(*running, return_exceptions=True)


async def _result(future: Future[Any], name: str) -> Ended:
    """Return what a job gave, or why Dask could not run it."""
    try:
        return name, await future
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
