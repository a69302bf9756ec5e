"""Plots of a run: error against run time, and the daemon's latency."""

from __future__ import annotations

from math import log10
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from touchd.evaluation.plots.session import COLOURS, save
from touchd.lab.benchmark.results import BUS_RATE_HZ, BareTimes, DaemonResult, EstimatorResult, Run
from touchd.lab.reproduction.paper import HEADS, KEYPAD_MS, REGRESSION_MS

GROUPS = {
    "atlas": ("field atlas", COLOURS[1], "*"),
    "network": ("shipped networks", COLOURS[0], "o"),
    "route": ("the default network, computed otherwise", COLOURS[2], "s"),
    "dictionary": ("compared with recorded touches", COLOURS[3], "D"),
    "given": ("other models", COLOURS[5], "^"),
}
PAPER = "#555555"
BY_ITS_RECIPE_MM = {"R": 6.0, "C-10": 8.1}
"""Median error of the paper's heads, trained by its recipe on the twin's full plate: docs/reproduction.md."""
PLAIN = FuncFormatter(lambda value, _position: f"{value:,g}")
SAME_HEIGHT, SAME_PLACE = 0.1, 0.9
"""Distance in decades of error and of time below which labels would overlap."""
RATES = (125.0, 500.0, 1000.0)


def draw(run: Run, folder: Path) -> list[str]:
    """Write the plots of a run into a folder, and return their file names.

    Raises
    ------
    OutputError
        A plot cannot be written.
    """
    save(draw_errors(run), folder / "errors.png")
    names = ["errors.png"]
    if any(cell.rate_hz for cell in run.daemon):
        save(draw_latency(run), folder / "latency.png")
        names.append("latency.png")
    return names


def draw_errors(run: Run) -> Figure:
    """Plot the median error of each estimator against its median run time."""
    figure = Figure(figsize=(9.6, 6.2), layout="constrained")
    axes = figure.add_subplot()
    for group, (label, colour, marker) in GROUPS.items():
        members = [one for one in run.estimators if one.group == group]
        if not members:
            continue
        axes.errorbar(
            [one.p50_us for one in members], [one.median_mm for one in members],
            xerr=[[0.0] * len(members), [one.p99_us - one.p50_us for one in members]],
            fmt=marker, color=colour, ms=13 if marker == "*" else 7, elinewidth=1, capsize=2, label=label,
        )  # fmt: skip
    reported = HEADS["R", "frequency"]
    axes.plot(1e3 * REGRESSION_MS, reported.mean_mm, "X", color=PAPER, ms=9, label="the paper (mean error, its rig)")
    _say(axes, 1e3 * REGRESSION_MS, reported.mean_mm, "paper's regression, 0.44 ms", (8, 0))
    axes.plot(
        [run.bare_us.p50] * len(BY_ITS_RECIPE_MM), list(BY_ITS_RECIPE_MM.values()), "P", color=PAPER, ms=8,
        label="its heads on the twin, without features",
    )  # fmt: skip
    for head, median_mm in BY_ITS_RECIPE_MM.items():
        _say(axes, run.bare_us.p50, median_mm, f"{head}  ", (-28 if head == "R" else -36, 0))
    axes.axvline(1e3 * KEYPAD_MS, color=PAPER, lw=1, ls=":")
    axes.axvline(run.bare_us.p50, color="black", lw=1, ls="--")
    axes.set(xscale="log", yscale="log", xlabel="one position: median, bar to the 99th percentile (us)",
             ylabel="median error (mm)")  # fmt: skip
    _spell_out(axes)
    low, high = axes.get_ylim()
    bound_mm = run.touches.bound_mm
    if bound_mm is not None:
        axes.axhline(bound_mm, color=COLOURS[4], lw=1.4, ls="-.")
        low = min(low, bound_mm / 1.8)
    axes.set_ylim(low / 1.7, high * 2)
    axes.set_xlim(left=min(run.bare_us.p50, *(one.p50_us for one in run.estimators)) / 1.8)  # room for names
    _label_all(axes, run)
    bottom = axes.get_ylim()[0] * 1.1
    for x_us, text, colour in ((run.bare_us.p50, "bare network", "black"), (1e3 * KEYPAD_MS, "paper's keypad", PAPER)):
        axes.text(x_us, bottom, f" {text}, {x_us * 1e-3:.2g} ms", fontsize=8, color=colour)
    if bound_mm is not None:
        axes.text(
            axes.get_xlim()[1] / 1.05, bound_mm * 1.06, f"Cramer-Rao bound, {bound_mm:.3f} mm", fontsize=8, ha="right",
            color=COLOURS[4],
        )  # fmt: skip
    axes.grid(alpha=0.25, which="both")
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    axes.set_title(f"{run.touches.count} touches of a {run.touches.finger} finger, unseen in training", fontsize=11)
    return figure


def _label_all(axes: Axes, run: Run) -> None:
    """Label every point; at equal height the leftmost gets the highest label, so that no line crosses a label."""
    levels: list[list[EstimatorResult]] = []
    for one in sorted(run.estimators, key=lambda one: one.p50_us):
        near = (
            level for level in levels
            if abs(log10(one.median_mm / level[-1].median_mm)) < SAME_HEIGHT
            and log10(one.p50_us / level[-1].p50_us) < SAME_PLACE
        )  # fmt: skip
        known = next(near, None)
        if known is None:
            levels.append([one])
        else:
            known.append(one)
    for level in levels:
        for lines, one in enumerate(reversed(level)):
            colour = GROUPS[one.group][1]
            axes.annotate(
                one.name, (one.p50_us, one.median_mm), (1, 9 + 11 * lines), textcoords="offset points", fontsize=8,
                va="bottom", color=colour, bbox={"fc": "white", "ec": "none", "pad": 0.4, "alpha": 0.8},
            )  # fmt: skip
            axes.annotate(
                "", (one.p50_us, one.median_mm), (0, 19 + 11 * lines), textcoords="offset points",
                arrowprops={"arrowstyle": "-", "lw": 0.6, "color": colour, "shrinkA": 0, "shrinkB": 0},
            )  # fmt: skip


def draw_latency(run: Run) -> Figure:
    """Plot the latency of every scene and rate, and the frames per second of processor time."""
    figure = Figure(figsize=(10.4, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.9, 1))
    scenes = list(dict.fromkeys(cell.scene for cell in run.daemon))
    for number, scene in enumerate(scenes):
        cells = [cell for rate in RATES if (cell := run.cell(scene, rate)) is not None]
        _bars(left, cells, number, len(scenes))
    left.axhline(1e3 * REGRESSION_MS, color=PAPER, lw=1, ls=":")
    left.axhline(1e3 * KEYPAD_MS, color=PAPER, lw=1, ls=":")
    left.set(yscale="log", ylabel="frame complete to subscriber (us)", xlabel="frames per second",
             xticks=range(len(RATES)), xticklabels=[f"{rate:,.0f}" for rate in RATES], xlim=(-0.55, 3.25))  # fmt: skip
    if run.bus_us is not None:
        x = RATES.index(BUS_RATE_HZ) + len(scenes) / 2 * 0.14
        _bar(left, x, run.bus_us, "black", "the bus alone")
    left.text(3.23, 1e3 * REGRESSION_MS, "paper: 0.44 ms", fontsize=8, color=PAPER, ha="right", va="bottom")
    left.text(3.23, 1e3 * KEYPAD_MS, "paper: 0.28 ms", fontsize=8, color=PAPER, ha="right", va="top")
    left.set_title("dot: median; bar: to the 99th; tick: 99.9th percentile (idle: to the decision)", fontsize=10)
    _spell_out(left, x=False)
    left.grid(alpha=0.25, axis="y", which="both")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=len(scenes) + 1, frameon=False, fontsize=9)
    full = [cell for scene in scenes if (cell := run.cell(scene, None)) is not None]
    right.barh([cell.scene for cell in full], [cell.frames_per_cpu_s for cell in full],
               color=[COLOURS[scenes.index(cell.scene)] for cell in full])  # fmt: skip
    for i, cell in enumerate(full):
        right.text(cell.frames_per_cpu_s, i, f" {cell.frames_per_cpu_s:,.0f}", va="center", fontsize=9)
    right.set(xscale="log", xlabel="frames per CPU second, full speed")
    right.xaxis.set_major_formatter(PLAIN)
    right.invert_yaxis()
    if full:
        right.set_xlim(min(cell.frames_per_cpu_s for cell in full) / 4, 5 * max(cell.frames_per_cpu_s for cell in full))
    right.grid(alpha=0.25, axis="x")
    right.set_axisbelow(True)
    return figure


def _bars(axes: Axes, cells: list[DaemonResult], number: int, count: int) -> None:
    for cell in cells:
        assert cell.rate_hz is not None
        x = RATES.index(cell.rate_hz) + (number - (count - 1) / 2) * 0.14
        times = BareTimes(p50=cell.p50_us, p99=cell.p99_us, p999=cell.p999_us)
        _bar(axes, x, times, COLOURS[number], cell.scene if cell is cells[0] else None)


def _bar(axes: Axes, x: float, times_us: BareTimes, colour: str, label: str | None) -> None:
    axes.plot([x, x], [times_us.p50, times_us.p99], color=colour, lw=3, alpha=0.6, solid_capstyle="butt")
    axes.plot(x, times_us.p999, "_", color=colour, ms=9, mew=1.6)
    axes.plot(x, times_us.p50, "o", color=colour, ms=7, label=label)


def _spell_out(axes: Axes, *, x: bool = True) -> None:
    """Label a logarithmic axis with plain numbers."""
    axes.yaxis.set_major_formatter(PLAIN)
    if x:
        axes.xaxis.set_major_formatter(PLAIN)


def _say(axes: Axes, x: float, y: float, text: str, offset: tuple[float, float]) -> None:
    axes.annotate(text, (x, y), offset, textcoords="offset points", fontsize=8, va="center", color=PAPER)
