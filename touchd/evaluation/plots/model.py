"""Plots of a model: learning curve, confusion of keys, calibration of sigma."""

from __future__ import annotations

from collections.abc import Sequence
from math import erf, sqrt

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from touchd.evaluation.model_scores import Judgement
from touchd.evaluation.plots.maps import MAP, NOTHING
from touchd.evaluation.plots.session import COLOURS, TRUTH
from touchd.localization.model import Description

ONE_SIGMA = 0.683
"""Share of Gaussian errors within one standard deviation."""


def draw_learning_curve(loss: Sequence[float], validation_mm: Sequence[float], kept: int) -> Figure:
    """Plot training loss and validation RMSE by epoch, and mark the kept epoch, counted from 1."""
    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    epochs = np.arange(1, len(loss) + 1)
    mark = "o" if len(loss) < 10 else ""
    above.plot(epochs, loss, color=COLOURS[1], lw=1.5, marker=mark)
    above.set(ylabel="training loss", title="learning curve")
    below.plot(epochs, validation_mm, color=COLOURS[0], lw=1.5, marker=mark, label="validation")
    best_mm = validation_mm[kept - 1]
    below.plot([kept], [best_mm], "o", color="black", ms=6, label=f"kept: epoch {kept}, {best_mm:.3g} mm")
    below.set(ylabel="RMSE (mm)", xlabel="epoch", yscale="log")
    _plain_ticks(below)
    below.xaxis.set_major_locator(MaxNLocator(integer=True))
    below.legend(frameon=False)
    for axes in (above, below):
        axes.grid(alpha=0.25, which="both")
    return figure


def draw_confusion(judged: Judgement, description: Description) -> Figure:
    """Plot the confusion matrix of the keys: counts, coloured by share of the row."""
    assert description.layout is not None
    names = [*(key.name for key in description.layout.key), "beside"]
    matrix = confusion(judged, len(names))
    touched = matrix.sum(axis=1, keepdims=True)
    share = np.ma.masked_invalid(np.where(touched > 0, 100 * matrix / np.maximum(touched, 1), np.nan))
    side = 2.8 + 0.36 * len(names)
    figure = Figure(figsize=(side + 0.8, side), layout="constrained")
    axes = figure.add_subplot()
    axes.set_facecolor(NOTHING)  # rows of keys without a touch
    image = axes.imshow(share, cmap=MAP, vmin=0, vmax=100)
    figure.colorbar(image, ax=axes, label="share of the touched key (%)", shrink=0.85)
    for row, column in np.argwhere(matrix):
        colour = "black" if share[row, column] > 50 else "white"
        axes.text(column, row, f"{matrix[row, column]}", ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(range(len(names)), names, rotation=90 if max(map(len, names)) > 6 else 0)
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="key found", ylabel="key touched", title=f"{len(judged.true_mm)} touches")
    return figure


def confusion(judged: Judgement, classes: int) -> NDArray[np.int64]:
    """Return the confusion matrix: true classes in rows, estimated in columns, shape (classes, classes)."""
    assert judged.true_class is not None
    assert judged.found_class is not None
    pair = judged.true_class * classes + judged.found_class
    return np.bincount(pair, minlength=classes**2).reshape(classes, classes)


def draw_sigma(judged: Judgement) -> Figure:
    """Plot the share of errors within k sigma, beside the Gaussian share, and actual against predicted error."""
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    ratio = np.sort((np.abs(judged.error_mm) / judged.sigma_mm[:, None]).ravel())
    k = np.linspace(0, 4, 161)
    found = np.searchsorted(ratio, k, side="right") / len(ratio)
    left.plot(k, [100 * erf(x / sqrt(2)) for x in k], color=TRUTH, lw=5, label="a Gaussian's")
    left.plot(k, 100 * found, color=COLOURS[0], lw=1.6, label="found, x and y")
    left.set(xlabel="k", ylabel="errors within k sigma (%)", xlim=(0, 4), ylim=(0, 102), title="all touches")
    left.legend(frameon=False, loc="lower right")
    predicted, actual = sigma_deciles(judged)
    ends = np.array([min(predicted.min(), actual.min()) / 1.5, max(predicted.max(), actual.max()) * 1.5])
    right.plot(ends, ends, color=TRUTH, lw=5, label="as predicted", zorder=1)
    right.plot(predicted, actual, "o", color=COLOURS[0], ms=6, label="a tenth of the touches each")
    right.set(
        xscale="log", yscale="log", xlim=ends, ylim=ends, xlabel="predicted: median sigma (mm)",
        ylabel="actual: 68 % of errors are below (mm)", title="touches in order of their sigma",
    )  # fmt: skip
    _plain_ticks(right)
    right.legend(frameon=False)  # matplotlib chooses the emptiest corner
    for axes in (left, right):
        axes.grid(alpha=0.25, which="both")
    return figure


def sigma_deciles(judged: Judgement) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return by deciles of sigma the median sigma, and the 68.3 % quantile of the absolute error per axis."""
    parts = np.array_split(np.argsort(judged.sigma_mm, kind="stable"), min(10, len(judged.sigma_mm)))
    predicted = np.array([np.median(judged.sigma_mm[part]) for part in parts])
    return predicted, np.array([np.quantile(np.abs(judged.error_mm[part]), ONE_SIGMA) for part in parts])


def _plain_ticks(axes: Axes) -> None:
    """Label logarithmic axes with plain numbers, some in each decade."""
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())
