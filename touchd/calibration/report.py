"""Write the report of a calibration: a folder with a page and plots, replaced as a whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure, FigureBase

from touchd import __version__
from touchd.calibration.calibrate import Calibrated, Fitted
from touchd.calibration.place_correction import widths_of
from touchd.calibration.taps import ErrorMap
from touchd.evaluation.plots.maps import MAP
from touchd.frame import Plate
from touchd.training.report.report import duration, write_folder
from touchd.training.report.template import render

TEMPLATE = Path(__file__).with_name("report.md.j2")
SHOWN_S = 1e-3
"""Length of the plotted response."""
GRID = 48
"""Places along each side of the map of the expected error."""
Maps = dict[str, tuple[np.ndarray, np.ndarray]]
"""By title the expected error (mm), and the discs, the emitter first."""


def write_calibration_report(fitted: Fitted, made: Calibrated | None, path: Path) -> Path:
    """Write the report beside a model, and return its folder.

    Of a poor fit without a model the folder has a name of its own: the report of the model that stays is kept.
    """
    pictures = {"response.png": draw_response(fitted), "residual.png": draw_residual(fitted)}
    error_mm = None
    if made is not None:
        told = (made.refined.placed_mm, made.refined.scatter_mm) if made.refined else ()
        error_mm = ErrorMap(made.atlas, made.fitted.noise_counts, widths_of(made.fitted.fit), GRID).after(*told)
        pictures["expected-error.png"] = draw_expected(fitted.fit.plate, {"": (error_mm, fitted.fit.layout.centres_mm)})
    text = render(
        TEMPLATE, name=path.name, fitted=fitted, fit=fitted.fit, made=made, pictures=list(pictures),
        error_mm=None if error_mm is None else np.percentile(error_mm, (50, 95, 100)).tolist(),
        duration=duration(fitted.duration_s + (made.duration_s if made else 0.0)), version=__version__,
    )  # fmt: skip
    return write_folder(path if made else path.with_suffix(".poor.onnx"), pictures, text)


def draw_response(fitted: Fitted) -> Figure:
    """Plot the untouched response of each channel, measured and fitted."""
    fit = fitted.fit
    time_ms = 1e3 * np.arange(fit.measured.shape[1]) / fit.acquisition.sample_rate_hz
    shown = time_ms <= 1e3 * SHOWN_S
    figure = Figure(figsize=(10.0, 1.9 * len(fit.measured)), layout="constrained")
    for channel, axes in enumerate(np.atleast_1d(figure.subplots(len(fit.measured), 1, sharex=True))):
        axes.plot(time_ms[shown], fit.measured[channel, shown], color="#b0b7bf", lw=3, label="measured")
        axes.plot(time_ms[shown], fit.fitted[channel, shown], color="#0b6e99", lw=1, label="fitted")
        axes.plot(time_ms[shown], (fit.measured - fit.fitted)[channel, shown], color="#d1495b", lw=0.8, label="left")
        axes.set_ylabel(f"receiver {channel + 1}")
    axes.set_xlabel("time (ms)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)
    return figure


def draw_residual(fitted: Fitted) -> Figure:
    """Plot what the fit leaves of each channel by frequency."""
    hz, share = fitted.fit.residual()
    a = fitted.fit.acquisition
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for channel, left in enumerate(share):
        axes.plot(hz / 1e3, 10 * np.log10(np.maximum(left, 1e-12)), lw=1, label=f"receiver {channel + 1}")
    for edge_hz in (a.chirp.start_hz, a.chirp.stop_hz):
        axes.axvline(edge_hz / 1e3, color="#b0b7bf", lw=1)
    axes.set(xlabel="frequency (kHz)", ylabel="energy left (dB of the channel's energy)")
    axes.legend(frameon=False)
    return figure


def draw_expected(plate: Plate, maps: Maps) -> Figure:
    """Plot maps of the expected error over a plate."""
    figure = Figure(figsize=(7.0 * len(maps), 6.0), layout="constrained")
    draw_maps(figure, plate, maps)
    return figure


def draw_maps(figure: FigureBase, plate: Plate, maps: Maps) -> None:
    """Plot maps of the expected error over a plate into a figure, or a part of one."""
    most = max(float(np.percentile(error_mm, 98)) for error_mm, _ in maps.values())
    panels = np.atleast_1d(figure.subplots(1, len(maps)))
    for axes, (title, (error_mm, discs_mm)) in zip(panels, maps.items(), strict=True):
        extent = (0, plate.width_mm, plate.height_mm, 0)  # y points down
        image = axes.imshow(error_mm, cmap=MAP, vmin=0, vmax=most, extent=extent)
        axes.plot(*discs_mm[0], "s", color="white", ms=7, markeredgecolor="black")
        axes.plot(*discs_mm[1:].T, "^", color="white", ms=7, markeredgecolor="black", ls="none")
        axes.set(xlabel="x (mm)", ylabel="y (mm)", title=title)
    figure.colorbar(image, ax=panels, label="expected error (mm)", extend="max", shrink=0.85)
