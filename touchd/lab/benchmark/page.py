"""Write a run as the page docs/benchmarks.md."""

from __future__ import annotations

from pathlib import Path

from touchd.config.schema import RealtimeSettings
from touchd.lab.benchmark import tables
from touchd.lab.benchmark.results import BareTimes, Run
from touchd.lab.benchmark.tables import Table
from touchd.training.report.template import render, table

TEMPLATE = Path(__file__).with_name("page.md.j2")


def page(run: Run, pictures: str) -> str:
    """Return the page of a run, with its plots in the folder `pictures` beside it."""
    calls = [one.calls for one in run.estimators]
    rss_mb = [cell.rss_mb for cell in run.daemon]
    return render(
        TEMPLATE, run=run, pictures=pictures, times=_times, awake_from_hz=RealtimeSettings().awake_from_hz,
        calls=(min(calls), max(calls)), rss_mb=(min(rss_mb, default=0.0), max(rss_mb, default=0.0)),
        has_latency=any(cell.rate_hz for cell in run.daemon),
        budgets=_markdown(tables.budget_table(run)), estimators=_markdown(tables.estimator_table(run)),
        daemon=_markdown(tables.daemon_table(run)), shares=_markdown(tables.share_table(run)),
        skips=_markdown(tables.skip_table(run)),
    )  # fmt: skip


def _times(one: BareTimes) -> str:
    return f"p50 {one.p50:,.0f}, p99 {one.p99:,.0f}, p99.9 {one.p999:,.0f}"


def _markdown(found: Table) -> str:
    return table(found.headings, found.rows)
