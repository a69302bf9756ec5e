"""Progress bars of long jobs."""

from __future__ import annotations

import time
from collections.abc import Callable
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


class Bars:
    """Bars on standard error, one for each part of a job, with the time left.

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
            self._tasks[what] = self._bar.add_task(what, note="")
        self._bar.update(self._tasks[what], completed=done, total=steps, note=note, refresh=self._at_steps)

    def warn(self, note: str) -> None:
        """Print a warning, clear of the bars."""
        self._bar.console.print(
            f"touchd: warning: {note}", style="bold yellow", markup=False, highlight=False, soft_wrap=True
        )
