"""Write a run as the page docs/benchmarks.md: of each table the columns, and of the daemon's the rows, that decide."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from touchd.config.schema import RealtimeSettings
from touchd.lab.benchmark import tables
from touchd.lab.benchmark.results import BareTimes, DaemonResult, Run
from touchd.training.report import template

TEMPLATE = Path(__file__).with_name("page.md.j2")
ESTIMATOR = ("estimator", "p50 us", "p99.9 us", "x bare", "median mm", "p95 mm", "missed")
DAEMON = ("scene", "frames/s", "ends at", "p50 us", "p99.9 us", "CPU", "frames/CPU s")
VARIANTS = ("regression, rfft", "regression, DFT in the graph", "regression, float64", "grid10", "keypad", "time")
"""Estimators that only the terminal and the stored run show."""


def page(run: Run, pictures: str) -> str:
    """Return the page of a run, with its plots in the folder `pictures` beside it."""
    estimators = tuple(one for one in run.estimators if one.name not in VARIANTS)
    shown = run.model_copy(update={"daemon": _decisive(run), "estimators": estimators})
    return template.render(
        TEMPLATE, run=run, shown=shown, pictures=pictures, times=_times, awake_from_hz=RealtimeSettings().awake_from_hz,
        has_latency=any(cell.rate_hz for cell in run.daemon),
        budgets=_markdown(tables.budget_table(run)), estimators=_markdown(tables.estimator_table(shown), ESTIMATOR),
        daemon=_markdown(tables.daemon_table(shown), DAEMON), skips=_markdown(tables.skip_table(run)),
    )  # fmt: skip


def _decisive(run: Run) -> tuple[DaemonResult, ...]:
    """Return of each scene the first rate and full speed."""
    first = {cell.scene: cell for cell in reversed(run.daemon)}
    return tuple(cell for cell in run.daemon if cell.rate_hz is None or cell is first[cell.scene])


def _times(one: BareTimes) -> str:
    return f"p50 {one.p50:,.0f}, p99 {one.p99:,.0f}, p99.9 {one.p999:,.0f}"


def _markdown(found: tables.Table, columns: Sequence[str] = ()) -> str:
    return template.Table(found.headings, found.rows).pick(columns=columns).markdown()
