"""Plots of the report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from touchd.evaluation.model_scores import Judgement
from touchd.evaluation.plots.model import draw_confusion
from touchd.evaluation.plots.session import COLOURS, TRUTH, save
from touchd.lab.reproduction import paper, run
from touchd.lab.reproduction.experiments import keypad_scores, loaded
from touchd.lab.reproduction.run import CIRCLE_HEADS, Results

DOMAIN_STYLE = {"frequency": (COLOURS[0], "o"), "time": (COLOURS[3], "s")}
PAPER = "black"


def draw(results: Results, folder: Path) -> None:
    """Write all plots of a report into a folder; raise OutputError if a plot cannot be written."""
    save(_heads(results), folder / "heads.png")
    save(_keypad(results), folder / "keypad.png")
    save(_learning(results), folder / "learning.png")
    if not results.given:
        save(_circle(results), folder / "circle.png")
        save(_errors(results), folder / "errors.png")


def _heads(results: Results) -> Figure:
    figure = Figure(figsize=(10.5, 4.3), layout="constrained")
    plate = results.recording.meta.plate
    areas = (
        ("full plate", results.full, plate.width_mm),
        ("central 11 x 11 cm", results.central, paper.CENTRAL_MM),
    )
    for number, (title, found, side_mm) in enumerate(areas):
        axes = figure.add_subplot(1, 2, number + 1)
        for domain in run.DOMAINS:
            colour, marker = DOMAIN_STYLE[domain]
            mean = {head: found[run.head_name(head, domain)].judged.distance_mm.mean() for head in run.HEADS}
            grids = [mean[f"C-{n}"] for n in run.GRIDS]
            axes.plot(run.GRIDS, grids, color=colour, marker=marker, ms=5, lw=1.5, label=f"C-N, {domain}")
            axes.axhline(mean["R"], color=colour, ls=":", lw=1.8, label=f"R, {domain}")
        perfect = [paper.perfect_mean_mm(side_mm, n) for n in run.GRIDS]
        axes.plot(run.GRIDS, perfect, color=TRUTH, lw=5, zorder=0, label="no zone mistaken")
        for n in (2, 10):
            reported = paper.HEADS[f"C-{n}", "frequency"].mean_mm
            axes.plot(n, reported, "*", color=PAPER, ms=11, label="the paper's C-2, C-10" if n == 2 else None)
        axes.set(xlabel="N", xticks=run.GRIDS, title=title, ylim=(0, None))
        axes.grid(alpha=0.25)
        if number == 0:
            axes.set_ylabel("mean error (mm)")
            axes.legend(fontsize=8, frameon=False)
    return figure


def _keypad(results: Results) -> Figure:
    trial = results.full[run.keypad_name(1.0, run.KEYPAD_SEEDS[0])]
    return draw_confusion(trial.judged, loaded(trial.model).description)


def _learning(results: Results) -> Figure:
    figure = Figure(figsize=(6.2, 4.0), layout="constrained")
    axes = figure.add_subplot()
    shares = np.array(run.SHARES)

    def accuracy_of(judged: Judgement) -> float:
        return keypad_scores(judged, results.layout)["accuracy"]

    contenders = (
        ("network", run.keypad_name, COLOURS[0], "o"),
        ("kNN (k = 1)", run.lookup_name, COLOURS[1], "s"),
    )
    for number, (label, name, colour, marker) in enumerate(contenders):
        accuracy = 100 * np.array([
            [accuracy_of(results.full[name(share, seed)].judged) for seed in run.KEYPAD_SEEDS]
            for share in run.SHARES
        ])  # fmt: skip
        mean, spread = accuracy.mean(axis=1), accuracy.std(axis=1)
        axes.errorbar(100 * shares, mean, spread, color=colour, marker=marker, ms=5, capsize=3, label=label)
        reported = [100 * values[number] for values in paper.KEYPAD_LEARNING.values()]
        where = [100 * share for share in paper.KEYPAD_LEARNING]
        axes.plot(where, reported, "*", color=colour, mec="black", ms=12, label=f"the paper's {label.split()[0]}")
    if not results.given:
        better = accuracy_of(results.full[run.BETTER_KEYPAD].judged)
        axes.plot(20, 100 * better, "D", color=COLOURS[2], ms=8, label="touchd's keypad")
    axes.set(xlabel="share of the training touches (%)", ylabel="accuracy of the keypad (%)", xticks=100 * shares)
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    return figure


def _circle(results: Results) -> Figure:
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    for number, name in enumerate((*CIRCLE_HEADS, "touchd")):
        judged = results.circle[name]
        axes = figure.add_subplot(1, 4, number + 1)
        axes.plot(*judged.true_mm.T, color=TRUTH, lw=6, solid_capstyle="round", label="true path")
        axes.plot(*judged.position_mm.T, ".", color=COLOURS[0], ms=3, label="estimated, each frame alone")
        title = f"{name}: mean {judged.distance_mm.mean():.1f} mm"
        axes.set(xlim=(0, 200), ylim=(200, 0), aspect="equal", xlabel="x (mm)", title=title)
        axes.grid(alpha=0.25)
        if number == 0:
            axes.set_ylabel("y (mm)")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return figure


def _errors(results: Results) -> Figure:
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    models = figure.add_subplot(1, 2, 1)
    contenders = {name: results.held_out[name, "silicone"] for name in ("regression", "int8", "small")}
    contenders |= {
        "kNN on residuals": results.full[run.dictionary_name("kNN", True)].judged,
        "GCC on residuals": results.full[run.dictionary_name("GCC", True)].judged,
        "the paper's R on the twin": results.full[run.head_name("R", "frequency")].judged,
    }
    for number, (name, judged) in enumerate(contenders.items()):
        models.ecdf(judged.distance_mm, color=COLOURS[number], lw=1.6, label=name)
    models.set(title="silicone finger", ylabel="share of touches")
    kinds = figure.add_subplot(1, 2, 2)
    labels = {
        "silicone": "silicone finger", "human": "human finger", "stale": "baseline stale by 1 K",
        "noise": "noise 20 dB worse",
    }  # fmt: skip
    for number, (kind, label) in enumerate(labels.items()):
        kinds.ecdf(results.held_out["regression", kind].distance_mm, color=COLOURS[number], lw=1.6, label=label)
    kinds.set(title="the shipped network")
    for axes in (models, kinds):
        axes.set(xlabel="error (mm)", xscale="log", xlim=(0.01, 50), ylim=(0, 1))
        axes.axvline(4.4, color=PAPER, ls="--", lw=1)
        axes.annotate("the paper's\nmean, 4.4 mm", (4.8, 0.06), fontsize=8)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.grid(alpha=0.25, which="both")
        axes.legend(fontsize=8, framealpha=1, edgecolor="none", loc="upper left")
    return figure
