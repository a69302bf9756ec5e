"""Progress of long jobs: bars on a terminal, lines in a file or pipe."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import timedelta
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

_SPEED_S = 3600.0
"""The time left follows from the steps of this time, s: from those of rich's half minute, a step a minute has none."""


_LINE_S = 10.0
"""A file or pipe gets a line for each part of a job, s."""


class Bars:
    """Bars on standard error, one for each part of a job, with the time left; lines where that is no terminal.

    They appear with the first step, so that an earlier error prints one line. Without `auto_refresh` they are drawn at
    steps alone, by no thread.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, *, auto_refresh: bool = True) -> None:
        self._bar = Progress(
            TextColumn("{task.description:8}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True),
            get_time=clock, speed_estimate_period=_SPEED_S, auto_refresh=auto_refresh,
        )  # fmt: skip
        self._tasks: dict[str, TaskID] = {}
        self._at_steps = not auto_refresh
        self._clock, self._said_s = clock, -_LINE_S

    def __enter__(self) -> Bars:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if self._bar.live.is_started:
            self._bar.stop()

    def update(self, what: str, done: int, steps: int, note: str = "") -> None:
        """Show that `done` of `steps` of a part are done."""
        terminal = self._bar.console.is_terminal
        if terminal:
            self._bar.start()
        if what not in self._tasks:
            self._tasks[what] = self._bar.add_task(what, note="")
        self._bar.update(self._tasks[what], completed=done, total=steps, note=note, refresh=terminal and self._at_steps)
        now_s = self._clock()
        if not terminal and (done == steps or now_s - self._said_s >= _LINE_S):
            self._said_s = now_s
            left_s = self._bar.tasks[self._tasks[what]].time_remaining
            left = f"{timedelta(seconds=left_s)} left" if left_s else ""
            self._print(", ".join(filter(None, [f"{what}: {done} of {steps}", note, left])))

    def warn(self, note: str) -> None:
        """Print a warning, clear of the bars."""
        self._print(f"touchd: warning: {note}", "bold yellow")

    def _print(self, line: str, style: str | None = None) -> None:
        self._bar.console.print(line, style=style, markup=False, highlight=False, soft_wrap=True)
