"""Tables of a run as text, for terminal and page, and the budgets that a run must hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from touchd.lab.benchmark.results import DaemonResult, Run
from touchd.lab.reproduction.paper import HEADS, KEYPAD_MS, REGRESSION_MS
from touchd.training.report.template import Table


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


def _of(scene: str, name: str, rate_hz: float | None = None) -> Callable[[Run], float | None]:
    return lambda run: getattr(cell, name) if (cell := run.cell(scene, rate_hz)) else None


BUDGETS = (
    Budget("idle frame, source to decision", "x bare", 0.25, _of("idle", "ratio")),
    Budget("still finger", "x bare", 0.6, _of("still", "ratio")),
    Budget("moving finger, source to message handed to the socket", "x bare", 2.0, _of("moving", "ratio")),
    Budget("keypad frame", "x bare", 0.8, _of("keypad", "ratio")),
    Budget(
        "moving finger at 1,000 frames/s, 99.9th percentile, to the socket", "us", 1000.0,
        _of("moving", "handed_p999_us", 1000.0),
    ),
    Budget("the same, to a subscriber on the daemon's processor", "us", 1000.0, _of("moving", "p999_us", 1000.0)),
    Budget(
        "the same, to a subscriber on another processor", "us", 1000.0,
        lambda run: run.apart.daemon_us.p999 if run.apart else None,
    ),
    Budget("idle, full speed", "frames/CPU s", 100_000.0, _of("idle", "frames_per_cpu_s"), True),
    Budget("moving finger, full speed", "frames/CPU s", 15_000.0, _of("moving", "frames_per_cpu_s"), True),
    Budget("start to ready", "s", 1.0, lambda run: min((cell.start_s for cell in run.daemon), default=None)),
    Budget(
        "resident memory in service", "MB", 120.0,
        lambda run: max((cell.rss_mb for cell in run.daemon if cell.rate_hz is not None), default=None),
    ),
)  # fmt: skip
"""Limits of a frame's cost relative to the bare network, and of latency, throughput, start and memory."""


def estimator_table(run: Run) -> Table:
    """Return time, error and cost of every estimator, with the paper's times."""
    headings = ("estimator", "p50 us", "p99 us", "p99.9 us", "max us", "x bare", "floor us", "RMSE mm", "median mm",
                "p95 mm", "missed", "k MACs", "kB")  # fmt: skip
    bare = run.bare_us
    rows = [["bare network", number(bare.p50), number(bare.p99), number(bare.p999), *["-"] * 9]]
    for one in run.estimators:
        times_us = (one.p50_us, one.p99_us, one.p999_us, one.max_us)
        errors_mm = (one.rmse_mm, one.median_mm, one.p95_mm)
        rows.append([
            one.name, *map(number, times_us), f"{one.ratio:.2f}", number(one.floor_us),
            *(f"{error_mm:.3f}" for error_mm in errors_mm), str(one.missed), f"{one.macs / 1e3:,.0f}",
            f"{one.bytes / 1e3:,.0f}",
        ])  # fmt: skip
    mean_mm = HEADS["R", "frequency"].mean_mm
    rows.append([f"paper: regression, mean error {mean_mm:g} mm", number(1e3 * REGRESSION_MS), *["-"] * 11])
    rows.append(["paper: keypad", number(1e3 * KEYPAD_MS), *["-"] * 11])
    return Table(headings, rows, "Run time against error")


def daemon_table(run: Run) -> Table:
    """Return the daemon's latency and load by scene and rate."""
    headings = ("scene", "frames/s", "ends at", "p50 us", "p99 us", "p99.9 us", "handed p50 us", "x bare", "CPU",
                "frames/CPU s", "MB", "GC pauses, longest us", "lost")  # fmt: skip
    rows = []
    for cell in run.daemon:
        rate = f"{cell.rate_hz:,.0f}" if cell.rate_hz is not None else f"full: {cell.frames_per_s:,.0f}"
        pauses = f"{cell.gc_pauses}, {number(cell.gc_longest_us)}" if cell.gc_pauses else "0"
        rows.append([
            cell.scene, rate, cell.to, *map(number, (cell.p50_us, cell.p99_us, cell.p999_us, cell.handed_p50_us)),
            f"{cell.ratio:.2f}", f"{cell.cpu_share:.1%}", f"{cell.frames_per_cpu_s:,.0f}", f"{cell.rss_mb:.0f}",
            pauses, str(cell.lost),
        ])  # fmt: skip
    return Table(headings, rows, "The daemon, from a frame complete to where it ends")


def share_table(run: Run) -> Table:
    """Return the share of skipped and inferred frames by scene."""
    reasons = list(dict.fromkeys(why for cell in run.daemon for why in cell.skipped if why != "learning"))
    rows = [
        [cell.scene, *(f"{cell.skipped.get(why, 0):.1%}" for why in reasons), f"{cell.inferred:.1%}"]
        for cell in first_rates(run)
    ]
    return Table(("scene", *reasons, "network"), rows, "What became of the frames")


def first_rates(run: Run) -> tuple[DaemonResult, ...]:
    """Return the result of each scene at its first rate."""
    first = {cell.scene: cell for cell in reversed(run.daemon)}
    return tuple(cell for cell in run.daemon if cell is first[cell.scene])


def skip_table(run: Run) -> Table:
    """Return the time that each skip saves."""
    rows = [
        [one.name, one.scene, number(one.with_us), number(one.without_us), f"{one.saved:.0%}", one.same]
        for one in run.skips
    ]
    return Table(("skip", "scene", "with, us", "without, us", "saved", "events"), rows, "What each skip saves")


def budget_table(run: Run) -> Table:
    """Return the budgets with the measured values."""
    rows = []
    for budget in BUDGETS:
        value = budget.read(run)
        if value is not None:
            bound = "at least" if budget.least else "at most"
            verdict = "held" if budget.holds(value) else "not held"
            rows.append([budget.what, f"{bound} {budget.limit:,g} {budget.unit}", number(value), verdict])
    return Table(("what", "budget", "measured", ""), rows, "Budgets")


def comparison_table(run: Run, other: Run) -> Table:
    """Return every time relative to the bare network, beside a stored run's."""
    rows = []
    ours, theirs = _ratios(run), _ratios(other)
    for name, now in ours.items():
        then = theirs.get(name)
        rows.append([
            name, f"{now:.2f}", "-" if then is None else f"{then:.2f}",
            "-" if not then else f"{now / then - 1:+.0%}",
        ])  # fmt: skip
    return Table(("what", "now", "stored", "change"), rows, "Ratios to the bare network")


def _ratios(run: Run) -> dict[str, float]:
    found = {one.name: one.ratio for one in run.estimators}
    for cell in run.daemon:
        rate = "full speed" if cell.rate_hz is None else f"{cell.rate_hz:g} frames/s"
        found[f"daemon, {cell.scene}, {rate}"] = cell.ratio
    return found


def number(value: float) -> str:
    """Format a value with about three digits, without exponent."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
