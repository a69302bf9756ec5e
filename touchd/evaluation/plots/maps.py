"""Maps of the plate: error, bias and misclassified zones."""

from __future__ import annotations

from math import sqrt
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from touchd.evaluation.model_scores import Judgement
from touchd.evaluation.plots.session import draw_transducers
from touchd.frame import Plate
from touchd.localization.model import Description
from touchd.recording.data import Meta

Floats = NDArray[np.float64]

MAP = "viridis"  # readable with colour blindness, and in grey
NOTHING = "#e8eaed"
ARROW, CHANCE = "#14213d", "#b8bec6"
CELL_TOUCHES = 6
"""Mean touches per cell of the error map: the median of fewer is too noisy."""
BIAS_TOUCHES = 24
"""Mean touches per cell of the bias map: enough for errors in random directions to cancel."""
MOST_CELLS = 25
"""Cells along either side."""


def cells_of(position_mm: NDArray[np.float32], plate: Plate, touches: int) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Return the cell of each of n positions, (n,), row by row, and the numbers of rows and columns.

    Cells are about square and hold `touches` touches on average.
    """
    side_mm = sqrt(plate.width_mm * plate.height_mm * touches / len(position_mm))
    columns, rows = (int(np.clip(round(length / side_mm), 3, MOST_CELLS)) for length in plate.size_mm)
    column, row = np.clip(position_mm / np.array(plate.size_mm), 0, 1 - 1e-9).T * [[columns], [rows]]
    return row.astype(int) * columns + column.astype(int), (rows, columns)


def cell_medians(position_mm: NDArray[np.float32], value: Floats, plate: Plate) -> tuple[Floats, NDArray[np.int64]]:
    """Return median value and number of touches per cell, shape (rows, columns); NaN without touches."""
    cell, shape = cells_of(position_mm, plate, CELL_TOUCHES)
    count = np.bincount(cell, minlength=shape[0] * shape[1])
    medians = np.array([np.median(value[cell == i]) if count[i] else np.nan for i in range(len(count))])
    return medians.reshape(shape), count.reshape(shape)


def cell_bias(
    position_mm: NDArray[np.float32], error_mm: Floats, plate: Plate
) -> tuple[Floats, Floats, NDArray[np.bool_], float]:
    """Return the bias of a model in each of the c cells with three touches or more.

    In order: centres and biases (c, 2), mm, which biases are beyond chance (c,), and a cell's shorter side, mm.

    The bias is the median error per axis, which ignores gross errors. It is significant if a cell without bias exceeds
    it in 1 of 20 cases: the standard error of a median is 1.25 times that of a mean, estimated from the median absolute
    deviation.
    """
    cell, (rows, columns) = cells_of(position_mm, plate, BIAS_TOUCHES)
    size_mm = np.array([plate.width_mm / columns, plate.height_mm / rows])
    used = np.flatnonzero(np.bincount(cell, minlength=rows * columns) >= 3)
    bias_mm, beyond = np.empty((len(used), 2)), np.empty(len(used), bool)
    for i, number in enumerate(used):
        mine = error_mm[cell == number]
        bias_mm[i] = np.median(mine, axis=0)
        spread_mm = 1.4826 * np.median(np.abs(mine - bias_mm[i]), axis=0)
        # P(chi^2 of two degrees of freedom > 5.99) = 5 %.
        beyond[i] = np.sum((bias_mm[i] / np.maximum(1.2533 * spread_mm, 1e-12)) ** 2) * len(mine) > 5.99
    centre_mm = (np.stack([used % columns, used // columns], axis=1) + 0.5) * size_mm
    return centre_mm, bias_mm, beyond, float(size_mm.min())


def draw_error_map(judged: Judgement, meta: Meta) -> Figure:
    """Plot the median error of each cell."""
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    _error_map(figure, figure.add_subplot(), judged, meta)
    return figure


def draw_maps(judged: Judgement, meta: Meta, remark: str = "") -> Figure:
    """Plot the median error of each cell, and beside it the bias; `remark` is the title of both."""
    figure = Figure(figsize=(13.5, 6.4 if remark else 6.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    _error_map(figure, left, judged, meta)
    _bias_map(right, judged, meta)
    if remark:
        figure.suptitle(remark, fontsize=11)
    return figure


def _error_map(figure: Figure, axes: Axes, judged: Judgement, meta: Meta) -> None:
    medians, count = cell_medians(judged.true_mm, judged.distance_mm, meta.plate)
    # Clip the scale, so that one cell with a large error does not hide the differences of the others.
    top = max(float(np.nanpercentile(medians, 95)), 1e-6)
    _cell_map(figure, axes, meta, medians, count, top, "median error (mm)", extend="max")
    axes.set_title(f"error of {len(judged.true_mm)} touches; number per cell; grey: none", fontsize=10)


def _cell_map(
    figure: Figure, axes: Axes, meta: Meta, value: Floats, count: NDArray[np.int64], top: float, label: str,
    extend: Literal["neither", "max"] = "neither",
) -> None:  # fmt: skip
    """Plot a value per cell, shape (rows, columns), with the number of touches in each."""
    plate, (rows, columns) = meta.plate, value.shape
    extent = (0, plate.width_mm, plate.height_mm, 0)  # y points down
    image = axes.imshow(np.ma.masked_invalid(value), cmap=MAP, vmin=0, vmax=top, extent=extent)
    figure.colorbar(image, ax=axes, label=label, extend=extend, shrink=0.85)
    for row, column in np.argwhere(count > 0):
        x_mm, y_mm = (column + 0.5) * plate.width_mm / columns, (row + 0.5) * plate.height_mm / rows
        colour = "black" if value[row, column] > top / 2 else "white"
        axes.text(x_mm, y_mm, f"{count[row, column]}", ha="center", va="center", fontsize=7, color=colour)
    _draw_plate(axes, meta)


def _bias_map(axes: Axes, judged: Judgement, meta: Meta) -> None:
    centre_mm, bias_mm, beyond, side_mm = cell_bias(judged.true_mm, judged.error_mm, meta.plate)
    _draw_plate(axes, meta)
    axes.set_facecolor("white")
    axes.set_aspect("equal")
    axes.set_title("bias: median error of each cell, as an arrow; dark: significant (5 %)", fontsize=10)
    rows, columns = cells_of(judged.true_mm, meta.plate, BIAS_TOUCHES)[1]
    for draw, parts, length_mm in (
        (axes.axvline, columns, meta.plate.width_mm),
        (axes.axhline, rows, meta.plate.height_mm),
    ):
        for i in range(1, parts):
            draw(i * length_mm / parts, color=NOTHING, lw=0.8, zorder=0)
    length_mm = np.linalg.norm(bias_mm, axis=1)
    if not length_mm.any():
        return
    # Scale by the 90th percentile: a few long arrows leave their cell, the others stay visible.
    scale = max(float(np.percentile(length_mm, 90)), float(length_mm.max()) / 2) / (0.95 * side_mm)
    for chosen, colour in ((~beyond, CHANCE), (beyond, ARROW)):
        arrows = axes.quiver(
            *centre_mm[chosen].T, *bias_mm[chosen].T, color=colour, angles="xy", scale_units="xy", pivot="middle",
            scale=scale, width=0.0045, clip_on=False,
        )  # fmt: skip
        arrows.set_in_layout(False)  # arrows may reach beyond the axes
    unit_mm = _round_down(side_mm * scale)
    axes.quiverkey(arrows, 0.9, -0.115, unit_mm, f"{unit_mm:g} mm", labelpos="W", coordinates="axes")


def _round_down(length: float) -> float:
    """Round a length down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)) * power)


def draw_zones(judged: Judgement, description: Description, meta: Meta) -> Figure:
    """Plot the share of misclassified touches in each zone of a grid."""
    assert judged.true_class is not None
    assert judged.found_class is not None
    n = description.grid
    count = np.bincount(judged.true_class, minlength=n**2)
    wrong = np.bincount(judged.true_class[judged.found_class != judged.true_class], minlength=n**2)
    share = np.divide(100.0 * wrong, count, out=np.full(n**2, np.nan), where=count > 0).reshape(n, n)
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axes = figure.add_subplot()
    _cell_map(figure, axes, meta, share, count.reshape(n, n), 100.0, "misclassified touches (%)")
    axes.set_title(f"{n} x {n} zones, {len(judged.true_mm)} touches; number per zone", fontsize=10)
    return figure


def _draw_plate(axes: Axes, meta: Meta) -> None:
    plate = meta.plate
    axes.set_facecolor(NOTHING)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", xlim=(0, plate.width_mm), ylim=(plate.height_mm, 0))
    draw_transducers(meta, axes, colour="white")
    if meta.receivers_mm or meta.emitter_mm:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=2, frameon=False)
