"""Jobs on Dask: on worker processes of this computer, or on a cluster that already runs."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import asynccontextmanager, contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

import structlog

from touchd.errors import ClusterError, JobError
from touchd.jobs.job import Failure, Outcome, Outcomes, Parcel, Task, perform
from touchd.jobs.local import connected_here, quiet

if TYPE_CHECKING:
    from distributed import Client, Future

T = TypeVar("T")
log = structlog.get_logger()

CONNECT_S = 8.0
"""A scheduler must answer within this time."""
WORKERS_S = 20.0
"""A run ends when there has been no worker for this time."""
CHECK_S, START_CHECK_S = 1.0, 0.1
"""Workers are counted this often while no job ends, and until the first worker is there."""
STOP_S = 3.0
"""A run that ends early gives Dask this time to disconnect."""
AGAIN = "run again; what is finished is kept"


def on_dask(tasks: Sequence[Task], parcels: Mapping[str, Parcel], where: str | int) -> Outcomes:
    """Run tasks on the workers of the scheduler at an address, or on a number of worker processes of this computer.

    Dask runs in a thread of its own; the caller's thread only waits for outcomes, and for Ctrl-C as for one of them. So
    an interrupt never comes amid Dask's code, where it could leave locks taken, and is never lost.

    Raises
    ------
    ClusterError
        When no scheduler answers at the address, it has no workers, or it goes away.
    """
    outcomes: SimpleQueue[Outcome | BaseException | None] = SimpleQueue()
    stops: SimpleQueue[Callable[[], object]] = SimpleQueue()

    async def work() -> None:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None
        stops.put(lambda: loop.call_soon_threadsafe(task.cancel))
        async with _connected(where) if isinstance(where, str) else connected_here(where) as client:
            await _run(client, where if isinstance(where, str) else "this computer", tasks, parcels, outcomes.put)

    def drive() -> None:
        try:
            asyncio.run(work())
            outcomes.put(None)
        except BaseException as error:
            outcomes.put(error)

    thread = threading.Thread(target=drive, name="touchd-dask", daemon=True)
    with _interrupts_put(outcomes.put):
        thread.start()
        try:
            while (outcome := _next(outcomes)) is not None:
                if isinstance(outcome, BaseException):
                    raise outcome
                yield outcome
        finally:
            with suppress(Empty, RuntimeError):  # never begun, or already ended
                stops.get(timeout=STOP_S)()
                thread.join(STOP_S)


def _next(outcomes: SimpleQueue[T]) -> T:
    """Wait for an outcome, in pieces: a signal that comes just before a wait does not end it."""
    while True:
        with suppress(Empty):
            return outcomes.get(timeout=CHECK_S)


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
    if came:  # after the last outcome
        raise came[0]


@asynccontextmanager
async def _connected(address: str) -> AsyncIterator[Client]:
    """Connect to a scheduler; keys for TLS are those of Dask's own configuration."""
    from distributed import Client

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
    client: Client, address: str, tasks: Sequence[Task], parcels: Mapping[str, Parcel], put: Callable[[Outcome], object]
) -> None:
    """Run as many tasks at a time as there are workers; those that have not begun when one fails never begin.

    Workers may come and go. A cluster begins a job again whose worker died, until it has lost several with that job.
    """
    waiting, running, failed, without_s = deque(tasks), set[asyncio.Task[Outcome]](), False, 0.0
    try:
        async with asyncio.timeout(WORKERS_S):
            while not (workers := await client.nthreads()):
                await asyncio.sleep(START_CHECK_S)
        crowded = [worker for worker, threads in workers.items() if threads > 1]
        if crowded:
            log.warning("jobs run one at a time in a worker: start it with --nthreads 1", workers=crowded)
        sent = await client.scatter(dict(parcels), broadcast=True, hash=False) if parcels else {}
        while running or (waiting and not failed):
            workers = await client.nthreads()
            without_s = 0.0 if workers else without_s + CHECK_S
            if without_s > WORKERS_S:
                raise TimeoutError
            while waiting and not failed and len(running) < len(workers):
                task = waiting.popleft()
                own = [sent[name] for name in task.job.shared]
                future = client.submit(_on_worker, task, own, pure=False)
                running.add(asyncio.create_task(_outcome(future, task.job.name)))
            if not running:
                await asyncio.sleep(CHECK_S)
                continue
            done, running = await asyncio.wait(running, timeout=CHECK_S, return_when=asyncio.FIRST_COMPLETED)
            for each in done:
                failed |= isinstance(each.result().result, Failure)
                put(each.result())
    except TimeoutError as error:
        raise ClusterError(f"no worker for {WORKERS_S:g} s", address, f"start some, and {AGAIN}") from error
    except (OSError, CancelledError) as error:
        what = f"the scheduler has gone ({type(error).__name__})"
        raise ClusterError(what, address, f"start it, and {AGAIN}") from error
    finally:
        for each in running:
            each.cancel()
        await asyncio.gather(*running, return_exceptions=True)


async def _outcome(future: Future[Any], name: str) -> Outcome:
    """Return what a job gave, or why Dask could not run it."""
    from distributed import KilledWorker

    try:
        return Outcome(name, await future)
    except (OSError, CancelledError):
        raise  # of the connection: a job's own are results
    except KilledWorker:
        killed = "its worker was killed, perhaps since memory ran out"
        return Outcome(name, Failure(JobError(killed, name, f"{AGAIN}; use fewer workers at a time")))
    except Exception as error:
        what = f"no worker can run the job ({type(error).__name__}: {error})"
        fix = "install the same versions of touchd, Python and Dask for scheduler and workers"
        return Outcome(name, Failure(ClusterError(what, name, fix)))


_one_at_a_time = threading.Lock()
"""A job owns its process: seeds and the number of threads are shared by all threads of a worker."""


def _on_worker(task: Task, parcels: Sequence[Parcel]) -> bytes | Failure:
    """Run a task in a thread of a Dask worker."""
    with _one_at_a_time:
        return perform(task, parcels)
