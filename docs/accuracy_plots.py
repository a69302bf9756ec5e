"""Pictures of docs/accuracy.md: learned field, error by noise and by training touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray

from touchd.evaluation.metrics import position_scores
from touchd.evaluation.model_scores import Judgement
from touchd.evaluation.plots.model import sigma_deciles
from touchd.evaluation.plots.session import COLOURS, TRUTH, draw_transducers
from touchd.frame import Plate
from touchd.recording.data import Meta

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

FLOOR_DB = -60.0
"""Lower limit of the spectrum's colour scale."""


@dataclass(frozen=True, slots=True)
class FieldImage:
    """True and learned field of one receiver and bin on a square grid."""

    x_mm: Floats
    y_mm: Floats
    true: Complex
    """Shape (rows, columns), in any unit."""
    learned: Complex
    """Scaled to fit `true` best."""
    frequency_hz: float
    wavenumber_per_mm: float
    """Wavenumber of the plate's A0 wave at `frequency_hz`, rad/mm."""
    channel: int


@dataclass(frozen=True, slots=True)
class NoiseLevel:
    """Estimates and bounds at one noise level."""

    noise_db: float
    """Signal-to-noise ratio of the untouched plate, dB."""
    judged: Judgement
    bound_mm: float
    """Cramer-Rao bound of the median error."""
    plain_mm: float
    """Median error of unweighted least squares."""


def draw_field(image: FieldImage, meta: Meta) -> Figure:
    """Plot the learned field, the spectrum of the true field, and their difference."""
    figure = Figure(figsize=(14.5, 4.3), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    khz = image.frequency_hz * 1e-3
    rms = float(np.sqrt(np.square(np.abs(image.true)).mean()))
    top = 2.5
    shown = left.imshow(image.learned.real / rms, cmap="RdBu_r", vmin=-top, vmax=top, extent=_extent(image))
    figure.colorbar(shown, ax=left, label="real part / RMS of the field", extend="both")
    left.set_title(f"learned field: {khz:.0f} kHz, receiver {image.channel + 1}", fontsize=10)
    _spectrum(figure, middle, image)
    off = 100 * np.abs(image.learned - image.true) / rms
    shown = right.imshow(off, cmap="viridis", vmin=0, vmax=float(np.percentile(off, 98)), extent=_extent(image))
    figure.colorbar(shown, ax=right, label="difference (% of the RMS)", extend="max")
    right.set_title(f"learned less true field: median {np.median(off):.1f} %", fontsize=10)
    for axes in (left, right):
        _frame(axes, meta)
    return figure


def _spectrum(figure: Figure, axes: Axes, image: FieldImage) -> None:
    rows, columns = image.true.shape
    tapered = image.true * np.hanning(rows)[:, None] * np.hanning(columns)
    size = 512
    power = np.abs(np.fft.fftshift(np.fft.fft2(tapered, (size, size)))) ** 2
    level_db = 10 * np.log10(power / power.max() + 1e-12)
    reach = pi / float(image.x_mm[1] - image.x_mm[0])
    shown = axes.imshow(level_db, cmap="magma", vmin=FLOOR_DB, vmax=0, extent=(-reach, reach, reach, -reach))
    figure.colorbar(shown, ax=axes, label="power (dB)", extend="min")
    k = image.wavenumber_per_mm
    for radius, style, label in ((2 * k, "-", "2 k"), (k, ":", "k")):
        angle = np.linspace(0, 2 * pi, 200)
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), style, color="white", lw=1.3, label=label)
    axes.legend(loc="upper right", labelcolor="white", facecolor="black", framealpha=0.4, edgecolor="none")
    limit = min(reach, 4 * k)
    axes.set(xlim=(-limit, limit), ylim=(limit, -limit), xlabel="kx (rad/mm)", ylabel="ky (rad/mm)")
    axes.set_title("spatial spectrum of the true field", fontsize=10)


def draw_noise(levels: Sequence[NoiseLevel]) -> Figure:
    """Plot error and bound by noise, and actual against predicted error at each noise level."""
    figure = Figure(figsize=(11.5, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    noise_db = [level.noise_db for level in levels]
    scores = [position_scores(level.judged.error_mm) for level in levels]
    left.plot(noise_db, [s["p95_mm"] for s in scores], "^-", color=COLOURS[3], label="95th percentile of the error")
    left.plot(noise_db, [s["median_mm"] for s in scores], "o-", color=COLOURS[0], label="median error")
    plain = [level.plain_mm for level in levels]
    left.plot(noise_db, plain, "--", color=COLOURS[0], lw=1, label="median with the exact field")
    bound = [level.bound_mm for level in levels]
    left.plot(noise_db, bound, "-", color=TRUTH, lw=4, zorder=0, label="Cramer-Rao bound, median")
    left.set(
        xlabel="noise below the untouched signal (dB)", ylabel="error (mm)", yscale="log", title="error by noise",
        xticks=noise_db,
    )  # fmt: skip
    left.invert_xaxis()  # noise grows to the right
    left.legend(frameon=False, fontsize=9)
    low, high = np.inf, 0.0
    for level, colour in zip(levels, COLOURS, strict=False):
        predicted, actual = sigma_deciles(level.judged)
        low, high = min(low, predicted.min(), actual.min()), max(high, predicted.max(), actual.max())
        right.plot(predicted, actual, "o-", color=colour, ms=5, lw=0.8, label=f"{level.noise_db:g} dB")
    ends = np.array([low / 1.4, high * 1.4])
    right.plot(ends, ends, color=TRUTH, lw=5, zorder=0, label="as predicted")
    right.set(
        xscale="log", yscale="log", xlim=ends, ylim=ends, xlabel="predicted: median sigma (mm)",
        ylabel="actual: 68 % of errors are below (mm)", title="predicted and actual error, by deciles of sigma",
    )  # fmt: skip
    right.legend(frameon=False, fontsize=9, loc="upper left")
    _plain_ticks(left.yaxis)
    _plain_ticks(right.xaxis)
    _plain_ticks(right.yaxis)
    for axes in (left, right):
        axes.grid(alpha=0.25)
    return figure


def draw_learning(touches: Sequence[int], scores: Sequence[dict[str, float]], freedom: float) -> Figure:
    """Plot the error by the number of training touches, with the field's degrees of freedom."""
    figure = Figure(figsize=(6.8, 4.6), layout="constrained")
    axes = figure.add_subplot()
    for name, label, style, colour in (
        ("p95_mm", "95th percentile", "^-", COLOURS[3]), ("rmse_mm", "RMSE", "s-", COLOURS[1]),
        ("median_mm", "median", "o-", COLOURS[0]),
    ):  # fmt: skip
        axes.plot(touches, [s[name] for s in scores], style, color=colour, label=label)
    axes.axvline(freedom, color=TRUTH, lw=4, zorder=0, label=f"degrees of freedom at 100 kHz: {freedom:.0f}")
    axes.set(
        xscale="log", yscale="log", xlabel="training touches", ylabel="error (mm)",
        title="error by training touches",
    )  # fmt: skip
    axes.set_xticks(list(touches), [str(n) for n in touches])
    axes.xaxis.set_minor_locator(NullLocator())
    _plain_ticks(axes.yaxis)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=9)
    return figure


def _extent(image: FieldImage) -> tuple[float, float, float, float]:
    half = float(image.x_mm[1] - image.x_mm[0]) / 2
    return (
        float(image.x_mm[0]) - half, float(image.x_mm[-1]) + half, float(image.y_mm[-1]) + half,
        float(image.y_mm[0]) - half,
    )  # fmt: skip


def _frame(axes: Axes, meta: Meta) -> None:
    plate: Plate = meta.plate
    axes.set(xlabel="x (mm)", ylabel="y (mm)", xlim=(0, plate.width_mm), ylim=(plate.height_mm, 0))
    draw_transducers(meta, axes, colour="white")


def _plain_ticks(axis: Axis) -> None:
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())
