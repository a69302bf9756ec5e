"""Progress bars of long jobs, with the time left."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

_KNOWN_SHARE = 0.05
"""No time left is estimated from a smaller share of the steps."""


class TimeLeft:
    """Estimates the time left of a job in steps, from the mean of the steps but the slowest: a cold cache strikes once.

    If the last fifth took longer than all on average, it counts instead: the steps of a field grow longer. `rich` has
    one slow step stand for all that follow while few are done.

    Parameters
    ----------
    clock : callable
        Monotonic time, s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._last_s = clock()
        self._begun = self._done = 0
        self._took_s: list[float] = []

    def update(self, done: int, steps: int) -> str:
        """Return the time left once `done` of `steps` are done, for a person; empty while nobody can know."""
        now_s = self._clock()
        if not self._begun:
            self._begun = self._done = done
            self._last_s = now_s
        elif steps_done := done - self._done:  # several at once share their time
            self._took_s += [(now_s - self._last_s) / steps_done] * steps_done
            self._done, self._last_s = done, now_s
        if done - self._begun - 1 < max(2, _KNOWN_SHARE * steps) or done == steps:
            return ""
        recent_s = self._took_s[-max(3, len(self._took_s) // 5) :]
        step_s = max((sum(some_s) - max(some_s)) / (len(some_s) - 1) for some_s in (self._took_s, recent_s))
        left_s = round(step_s * (steps - done))
        return f"{left_s // 3600}:{left_s // 60 % 60:02}:{left_s % 60:02} left"


class Bars:
    """Bars on standard error, one for each part of a job.

    They appear with the first step, so that an earlier error prints one line.
    """

    def __init__(self) -> None:
        self._bar = Progress(
            TextColumn("{task.description:8}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(), TextColumn("{task.fields[left]}"), console=Console(stderr=True),
        )  # fmt: skip
        self._tasks: dict[str, tuple[TaskID, TimeLeft]] = {}

    def __enter__(self) -> Bars:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if self._tasks:
            self._bar.stop()

    def update(self, what: str, done: int, steps: int, note: str = "") -> None:
        """Show that `done` of `steps` of a part are done."""
        self._bar.start()
        if what not in self._tasks:
            self._tasks[what] = self._bar.add_task(what, note="", left=""), TimeLeft()
        task, left = self._tasks[what]
        self._bar.update(task, completed=done, total=steps, note=note, left=left.update(done, steps))

    def warn(self, note: str) -> None:
        """Print a warning, clear of the bars."""
        self._bar.console.print(
            f"touchd: warning: {note}", style="bold yellow", markup=False, highlight=False, soft_wrap=True
        )
