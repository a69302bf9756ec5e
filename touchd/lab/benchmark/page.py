"""A run as the page docs/benchmarks.md: the template `page.md`, filled in."""

from __future__ import annotations

from pathlib import Path

from touchd.config.schema import RealtimeSettings
from touchd.lab import template
from touchd.lab.benchmark import tables
from touchd.lab.benchmark.results import BareTimes, Run
from touchd.lab.benchmark.tables import Table

TEMPLATE = Path(__file__).with_name("page.md")
FEW_FRAMES = 1000


def page(run: Run, pictures: str) -> str:
    """Return the page of a run; its pictures are in a folder of that name beside it."""
    return template.filled(TEMPLATE, _head(run, pictures) | _estimators(run) | _daemon(run, pictures) | _others(run))


def _head(run: Run, pictures: str) -> dict[str, object]:
    return {
        "version": run.machine.touchd,
        "command": "touchd benchmark --docs docs" + (" --quick" if run.quick else ""),
        "seconds": f"{run.seconds:.0f}",
        "machine": run.machine.line(),
        "pictures": pictures,
        "budgets": _markdown(tables.budget_table(run)),
        "skips": _markdown(tables.skip_table(run)),
    }


def _estimators(run: Run) -> dict[str, object]:
    t = run.touches
    calls = [one.calls for one in run.estimators]
    return {
        "count": t.count,
        "finger": t.finger,
        "seed": t.seed,
        "bound": None if t.bound_mm is None else f"{t.bound_mm:.4f}",
        "estimators": _markdown(tables.estimator_table(run)),
        "remarks": "\n".join(f"- `{one.name}`: {one.remark}." for one in run.estimators if one.remark),
        "least": f"{min(calls):,}",
        "most": f"{max(calls):,}",
        "left_out": "\n".join(f"- Left out: {what}." for what in run.left_out),
    }


def _daemon(run: Run, pictures: str) -> dict[str, object]:
    cells = run.daemon
    steady = any(cell.rate_hz for cell in cells)
    pauses, longest_us = sum(c.gc_pauses for c in cells), max((c.gc_longest_us for c in cells), default=0.0)
    return {
        "placed": run.apart and "They run both on one processor at a steady rate, each on its own at full speed.",
        "latency": f"{pictures}/latency.png" if steady else None,
        "daemon": _markdown(tables.daemon_table(run)),
        "shares": _markdown(tables.share_table(run)),
        "memory": f"{min(c.rss_mb for c in cells):.0f} to {max(c.rss_mb for c in cells):.0f}" if cells else None,
        "pauses": f"{pauses} pauses in all, the longest {longest_us:.0f} us" if cells else None,
        "few": f"{FEW_FRAMES:,}" if any(c.frames < FEW_FRAMES for c in cells) else None,
    }


def _others(run: Run) -> dict[str, object]:
    """Return what is measured beside the table."""
    day, apart, asleep = run.day, run.apart, run.asleep
    return {
        "day": day and f"{day.cpu_s_per_hour:.0f}",
        "idle": day and f"{day.idle:.0%}",
        "still": day and f"{day.still:.0%}",
        "moving": day and f"{day.moving:.0%}",
        "bus": _percentiles(run.bus_us),
        "late": run.held_up_us and _percentiles(run.held_up_us, digits=2),
        "apart": apart and _percentiles(apart.daemon_us),
        "apart_bus": apart and _percentiles(apart.bus_us),
        "awake_from": f"{RealtimeSettings().awake_from_hz:g}",
        "asleep": asleep and _percentiles(asleep.daemon_us),
    }


def _percentiles(times: BareTimes | None, digits: int = 0) -> str | None:
    if times is None:
        return None
    return f"p50 {times.p50:,.{digits}f}, p99 {times.p99:,.{digits}f}, p99.9 {times.p999:,.0f}"


def _markdown(table: Table) -> str:
    """Return a Markdown table: names to the left, numbers to the right."""
    text = {i for i in range(len(table.headings)) if any(not _is_number(row[i]) for row in table.rows)}
    return template.table(table.headings, table.rows, text)


def _is_number(text: str) -> bool:
    return text == "-" or text.replace(",", "").rstrip("%").replace("+", "-").lstrip("-").replace(".", "", 1).isdigit()
