"""Budgets: limits of a frame's cost relative to the bare network, and of latency, throughput, start and memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from touchd.lab.benchmark.results import Run


class Budget(NamedTuple):
    """One limit."""

    what: str
    unit: str
    limit: float
    read: Callable[[Run], float | None]
    """Returns the measured value of a run, None if not measured."""
    least: bool = False
    """Whether `limit` is a lower limit."""

    def holds(self, value: float, margin: float = 1.0) -> bool:
        """Return whether a value meets the limit, relaxed by the factor `margin`."""
        return value * margin >= self.limit if self.least else value <= margin * self.limit


def _full_speed(scene: str, name: str) -> Callable[[Run], float | None]:
    return lambda run: getattr(cell, name) if (cell := run.cell(scene, None)) else None


BUDGETS = (
    Budget("idle frame, source to decision", "x bare", 0.25, _full_speed("idle", "ratio")),
    Budget("still finger", "x bare", 0.6, _full_speed("still", "ratio")),
    Budget("moving finger, source to message handed to the socket", "x bare", 2.0, _full_speed("moving", "ratio")),
    Budget("keypad frame", "x bare", 0.8, _full_speed("keypad", "ratio")),
    Budget(
        "moving finger at 1,000 frames/s, 99.9th percentile, to the socket", "us", 1000.0,
        lambda run: cell.handed_p999_us if (cell := run.cell("moving", 1000.0)) else None,
    ),
    Budget(
        "the same, to a subscriber on the daemon's processor", "us", 1000.0,
        lambda run: cell.p999_us if (cell := run.cell("moving", 1000.0)) else None,
    ),
    Budget(
        "the same, to a subscriber on another processor", "us", 1000.0,
        lambda run: run.apart.daemon_us.p999 if run.apart else None,
    ),
    Budget("idle, full speed", "frames/CPU s", 100_000.0, _full_speed("idle", "frames_per_cpu_s"), True),
    Budget("moving finger, full speed", "frames/CPU s", 15_000.0, _full_speed("moving", "frames_per_cpu_s"), True),
    Budget(
        "start to ready", "s", 1.0,
        lambda run: min((cell.start_s for cell in run.daemon), default=None),
    ),
    Budget(
        "resident memory in service", "MB", 120.0,
        lambda run: max((cell.rss_mb for cell in run.daemon if cell.rate_hz is not None), default=None),
    ),
)  # fmt: skip
"""Budgets that a single run can check; memory growth and allocations have tests of their own."""
