"""Write a run as docs/benchmarks.md: the columns and rows that decide, and a plot of error against run time."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from touchd.evaluation.plots.session import COLOURS, save
from touchd.files import replacing, writing
from touchd.lab.benchmark import results, tables
from touchd.lab.benchmark.results import BareTimes, Run
from touchd.lab.reproduction.paper import HEADS, KEYPAD_MS, REGRESSION_MS
from touchd.training.report import template

TEMPLATE = Path(__file__).with_name("page.md.j2")
PICTURES = "benchmarks"
GROUPS = {
    "atlas": ("field atlas", COLOURS[1], "*"),
    "network": ("shipped networks", COLOURS[0], "o"),
    "given": ("other models", COLOURS[5], "^"),
}
PAPER = "#555555"
ESTIMATOR = ("estimator", "p50 us", "p99.9 us", "median mm", "missed")
DAEMON = ("scene", "frames/s", "p50 us", "p99.9 us", "CPU")
VARIANTS = ("grid10", "keypad", "time")
"""Estimators that only the terminal and the stored run show."""


def write(run: Run, folder: Path) -> None:
    """Write page, plot and results into `folder`; raise OutputError if a file cannot be written."""
    with writing(folder / PICTURES):
        (folder / PICTURES).mkdir(exist_ok=True)
    save(draw_errors(run), folder / PICTURES / "errors.png")
    results.store(run, folder / "benchmarks.json")
    with replacing(folder / "benchmarks.md") as file:
        file.write(page(run).encode())


def page(run: Run) -> str:
    """Return the page of a run, with its plot in the folder `PICTURES` beside it."""
    estimators = tuple(one for one in run.estimators if one.group in GROUPS and one.name not in VARIANTS)
    shown = run.model_copy(update={"daemon": tables.first_rates(run), "estimators": estimators})
    return template.render(
        TEMPLATE, run=run, shown=shown, pictures=PICTURES, times=_times,
        budgets=tables.budget_table(run).markdown(),
        estimators=tables.estimator_table(shown).pick(columns=ESTIMATOR).markdown(),
        daemon=tables.daemon_table(shown).pick(columns=DAEMON).markdown(),
        skips=", ".join(f"{one.name} ({one.scene}) {one.saved:.0%}" for one in run.skips),
    )  # fmt: skip


def _times(one: BareTimes) -> str:
    return f"p50 {one.p50:,.0f}, p99 {one.p99:,.0f}, p99.9 {one.p999:,.0f}"


def draw_errors(run: Run) -> Figure:
    """Plot the median error of each estimator against its median run time."""
    figure = Figure(figsize=(9.6, 6.2), layout="constrained")
    axes = figure.add_subplot()
    for group, (label, colour, marker) in GROUPS.items():
        some = [one for one in run.estimators if one.group == group and one.name not in VARIANTS]
        for one in some:
            axes.annotate(
                one.name, (one.p50_us, one.median_mm), (0, 9), textcoords="offset points", fontsize=8, color=colour
            )
        if some:
            axes.errorbar(
                [one.p50_us for one in some], [one.median_mm for one in some],
                xerr=[[0.0] * len(some), [one.p99_us - one.p50_us for one in some]],
                fmt=marker, color=colour, ms=13 if marker == "*" else 7, elinewidth=1, capsize=2, label=label,
            )  # fmt: skip
    reported_mm = HEADS["R", "frequency"].mean_mm
    axes.plot(1e3 * REGRESSION_MS, reported_mm, "X", color=PAPER, ms=9, label="the paper's regression (mean, its rig)")
    for x_us, name, colour in ((run.bare_us.p50, "bare network", "black"), (1e3 * KEYPAD_MS, "paper's keypad", PAPER)):
        axes.axvline(x_us, color=colour, lw=1, ls=":", label=f"{name}, {x_us * 1e-3:.2g} ms")
    if run.touches.bound_mm is not None:
        bound = f"Cramer-Rao bound, {run.touches.bound_mm:.3f} mm"
        axes.axhline(run.touches.bound_mm, color=COLOURS[4], lw=1.4, ls="-.", label=bound)
    axes.set(xscale="log", yscale="log", xlabel="one position: median, bar to the 99th percentile (us)",
             ylabel="median error (mm)")  # fmt: skip
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    axes.grid(alpha=0.25, which="both")
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    axes.set_title(f"{run.touches.count} touches of a {run.touches.finger} finger, unseen in training", fontsize=11)
    return figure
