"""Wait for jobs on Dask, and for Ctrl-C, whichever comes first."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue

from touchd.jobs.job import Ended, Task

CHECK_S = 1.0
"""A wait is interrupted this often: a signal that comes just before it does not end it."""
STOP_S = 3.0
"""A run that ends early gives Dask this time to disconnect."""


def on_dask(tasks: Sequence[Task], shared: Mapping[str, bytes], where: str | int) -> Generator[Ended]:
    """Run tasks on the workers of the scheduler at an address, or on a number of worker processes of this computer.

    Dask is imported and runs in a thread of its own; the caller's thread only waits for what has ended, and for Ctrl-C
    as for one of them. So an interrupt never comes amid Dask's code, where it could leave locks taken, and is never
    lost.

    Raises
    ------
    ClusterError
        When no scheduler answers at the address, it has no workers, or it goes away.
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
        except BaseException as error:
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
