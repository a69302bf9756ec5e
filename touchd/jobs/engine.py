"""Run tasks on workers, as many at a time as there are, until one fails or Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

from touchd.errors import TouchdError
from touchd.jobs.job import Ended, Task

CHECK_S = 1.0
"""A wait ends this often, to count workers, and for an interrupt that came just before it."""


class Workers(Protocol):
    """Where tasks run."""

    def count(self) -> int:
        """Return how many tasks can run at a time by now."""
        ...

    def begin(self, task: Task) -> None:
        """Give a task to a worker that has none."""
        ...

    def ended(self, timeout_s: float) -> Sequence[Ended]:
        """Return what has ended, after this time at most."""
        ...


def on_workers(tasks: Sequence[Task], where: AbstractContextManager[Workers]) -> Generator[Ended]:
    """Run tasks, and yield each that has ended; those that have not begun when one fails never begin."""
    waiting, running, failed = deque(tasks), 0, False
    with where as workers, _interrupts_kept() as came:
        while not came and (running or (waiting and not failed)):
            while waiting and not failed and running < workers.count():
                workers.begin(waiting.popleft())
                running += 1
            for each in workers.ended(CHECK_S):
                running -= 1
                failed |= isinstance(each[1], TouchdError)
                yield each


@contextmanager
def _interrupts_kept() -> Iterator[list[KeyboardInterrupt]]:
    """Keep a Ctrl-C in a list, and raise it at the end instead of wherever the main thread is.

    In a destructor or a callback, Python prints a raised one and goes on.
    """
    came: list[KeyboardInterrupt] = []
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is not signal.default_int_handler:
        yield came
        return
    signal.signal(signal.SIGINT, lambda *_: came.append(KeyboardInterrupt()))
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            raise came[0]
