"""Worker processes of this computer, of one thread each.

Each has a pipe that no other process can reach. The pipe's end also ends the worker, when this process has gone for any
reason.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe, wait
from queue import SimpleQueue
from typing import Any, NamedTuple

from touchd.errors import JobError
from touchd.jobs.job import AGAIN, ONE_THREAD, Ended, Task, perform

WORKER = "from touchd.jobs.processes import work; work()"


class _Worker(NamedTuple):
    process: subprocess.Popen[bytes]
    pipe: Connection[Any, Any]


class Processes:
    """Workers that start when they are needed, and are killed when the context is left.

    Parameters
    ----------
    most : int
    shared : mapping
        Pickled objects by name, for each worker.
    """

    def __init__(self, most: int, shared: Mapping[str, bytes]) -> None:
        self._most, self._shared = most, shared
        self._idle: list[_Worker] = []
        self._busy: dict[Any, tuple[_Worker, str]] = {}

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in [*self._idle, *(worker for worker, _ in self._busy.values())]:
            worker.process.kill()
            worker.process.wait()
            worker.pipe.close()

    def count(self) -> int:
        """Return how many tasks can run at a time."""
        return self._most

    def begin(self, task: Task) -> None:
        """Give a task to an idle worker, or to a new one."""
        worker = self._idle.pop() if self._idle else self._start()
        self._busy[worker.pipe] = worker, task.job.name
        with suppress(OSError):  # it has ended, which `ended` sees
            worker.pipe.send(task)

    def ended(self, timeout_s: float) -> Sequence[Ended]:
        """Return what has ended, after this time at most."""
        found: list[Ended] = []
        for pipe in wait(list(self._busy), timeout_s):
            worker, name = self._busy.pop(pipe)
            try:
                found.append((name, worker.pipe.recv()))
            except (EOFError, OSError):
                killed = f"its worker was killed, perhaps since memory ran out (status {worker.process.wait()})"
                found.append((name, JobError(killed, name, f"{AGAIN}; use fewer workers at a time")))
                worker.pipe.close()
            else:
                self._idle.append(worker)
        return found

    def _start(self) -> _Worker:
        """Start a worker beyond the reach of Ctrl-C, with the modules that this process can import."""
        ours, theirs = Pipe()
        path = os.pathsep.join(part or os.getcwd() for part in sys.path)
        process = subprocess.Popen(  # noqa: S603 - this very Python
            [sys.executable, "-P", "-c", WORKER, str(theirs.fileno())], pass_fds=[theirs.fileno()],
            env=os.environ | ONE_THREAD | {"PYTHONPATH": path}, stdin=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        theirs.close()
        worker = _Worker(process, ours)
        with suppress(OSError):  # as in `begin`
            ours.send(self._shared)
        return worker


def work() -> None:
    """Be a worker, until the pipe ends."""
    pipe: Connection[Any, Any] = Connection(int(sys.argv[1]))
    received: SimpleQueue[Any] = SimpleQueue()

    def receive() -> None:
        with suppress(EOFError, OSError):
            while True:
                received.put(pipe.recv())
        os._exit(1)

    threading.Thread(target=receive, daemon=True).start()
    shared = received.get()
    while True:
        task = received.get()
        pipe.send(perform(task, [shared[name] for name in task.job.shared]))
