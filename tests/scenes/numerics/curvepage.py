"""Data and pictures of docs/robustness.md: each way of placing a finger, by what is made worse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isnan

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from tests.scenes.numerics import curves
from touchd.evaluation.plots.session import COLOURS

ATLAS, NETWORK, PAPER = "field atlas", "network alone", "paper's recipe"
STYLES = {ATLAS: ("o-", 0), NETWORK: ("s-", 2), PAPER: ("^-", 1), "kNN": ("D--", 3), "GCC": ("v--", 4)}


def small(value: float) -> str:
    """Return a length, a share or the like with two digits."""
    return "0" if value == 0 else f"{value:.2g}" if value >= 1e-3 else f"{value:.1e}".replace("e-0", "e-")


Known = Mapping[str, Sequence[tuple[float, float] | None]]


HEADINGS = ("estimator", "median_mm", "p95_mm", "placed")
"""Of `answer_rows`, after the value."""


def answer_rows(
    values: Sequence[float | str], answers: Sequence[dict[str, curves.Answer]], known: Known | None = None
) -> list[tuple[str, ...]]:
    """Return median, 95th percentile and the share of touches placed, for each value and contender."""
    rows: list[tuple[str, ...]] = []
    for number, (value, found) in enumerate(zip(values, answers, strict=True)):
        point = value if isinstance(value, str) else f"{value:g}"
        for name, pairs in (known or {}).items():
            if pair := pairs[number]:
                rows.append((point, name, f"{pair[0]:.3f}", f"{pair[1]:.2f}", ""))
        for name, answer in found.items():
            errors = ("" if isnan(mm) else f"{mm:.3g}" for mm in map(answer.percentile_mm, (50, 95)))
            rows.append((point, name, *errors, f"{answer.placed:.0%}"))
    return rows


def draw(
    values: Sequence[float | str], answers: Sequence[dict[str, curves.Answer]], label: str, title: str, *,
    logarithmic: bool = False, reverse: bool = False, known: Known | None = None,
) -> Figure:  # fmt: skip
    """Draw median, 95th percentile and the share that was placed."""
    refusing = [name for name in (ATLAS, NETWORK) if name in answers[0]]  # the others always answer
    figure = Figure(figsize=(13.0 if refusing else 9.4, 4.5), layout="constrained")
    panels = figure.subplots(1, 3 if refusing else 2)
    at = [float(i) if isinstance(v, str) else float(v) for i, v in enumerate(values)]
    for name, (style, colour) in STYLES.items():
        how = {"color": COLOURS[colour], "label": name, "ms": 5, "lw": 1.6 if name == ATLAS else 1.1}
        if isinstance(values[0], str):  # between them there is nothing to be joined
            style, how["ms"] = style[0], 7
        if known and name in known:
            pairs = [pair or (np.nan, np.nan) for pair in known[name]]
            panels[0].plot(at, [pair[0] for pair in pairs], style, **how)
            panels[1].plot(at, [pair[1] for pair in pairs], style, **how)
        elif name in answers[0]:
            mine = [row[name] for row in answers]
            panels[0].plot(at, [answer.percentile_mm(50) for answer in mine], style, **how)
            panels[1].plot(at, [answer.percentile_mm(95) for answer in mine], style, **how)
            if name in refusing:
                panels[2].plot(at, [100 * answer.placed for answer in mine], style, **how)
    for axes, what in zip(panels, ("median error (mm)", "95th percentile (mm)", "touches placed (%)"), strict=False):
        axes.set(xlabel=label, ylabel=what)
        axes.grid(alpha=0.25)
        if logarithmic:
            axes.set_xscale("log")
            axes.xaxis.set_minor_locator(NullLocator())
        names = [f"{v:g}" if not isinstance(v, str) else v for v in values]
        axes.set_xticks(at, names, rotation=45 if len(names) > 9 else 0, fontsize=8)
        if reverse:
            axes.invert_xaxis()
    for axes in panels[:2]:
        axes.set(yscale="log", ylim=(0.02, 300))
        axes.set_yticks(
            [0.03, 0.1, 0.3, 1, 3, 10, 30, 100, 300], ["0.03", "0.1", "0.3", "1", "3", "10", "30", "100", "300"]
        )
        axes.yaxis.set_minor_locator(NullLocator())
    if refusing:
        panels[2].set_ylim(-4, 104)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False, fontsize=9
    )
    figure.suptitle(title, fontsize=11)
    return figure
