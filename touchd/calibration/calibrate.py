"""From an untouched recording to a model: fit the plate, make its atlas and its scan, write both with a reference.

Beside the model lies a report: a folder with a page and plots, replaced as a whole.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure, FigureBase

from touchd import __version__
from touchd.calibration.error_map import ErrorMap
from touchd.calibration.physical_atlas import make_physical_atlas
from touchd.calibration.place_correction import widths_of
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.plate_fit import PlateFit, Progress, fit_plate
from touchd.calibration.soft_face import for_fingers
from touchd.calibration.start_scan import start_scan
from touchd.calibration.taps import Refined, orientation_of, refine, taps_of, turned_fit
from touchd.calibration.untouched import Untouched, untouched_acts, untouched_mean
from touchd.errors import OutputError
from touchd.evaluation.dataset import digest
from touchd.evaluation.plots.maps import MAP
from touchd.frame import Plate
from touchd.localization.atlas import Atlas, atlas_path, save_atlas
from touchd.localization.model import Description, Model
from touchd.localization.model_file import install, put_model
from touchd.recording.data import Recording
from touchd.recording.format import write
from touchd.training.report.report import duration, write_folder
from touchd.training.report.template import render

REFERENCE_FRAMES = 100
"""Frames kept beside the model, with which `touchd doctor` compares the plate."""
TEMPLATE = Path(__file__).with_name("report.md.j2")
SHOWN_S = 1e-3
"""Length of the plotted response."""
GRID = 48
"""Places along each side of the map of the expected error."""
Maps = dict[str, tuple[np.ndarray, np.ndarray]]
"""By title the expected error (mm), and the discs, the emitter first."""


@dataclass(frozen=True)
class Fitted:
    """A plate fitted to a recording."""

    recording: Recording
    untouched: Untouched
    fit: PlateFit
    duration_s: float

    @property
    def noise_counts(self) -> float:
        """Standard deviation of a sample's noise, ADC counts."""
        return float(np.sqrt(np.square(self.untouched.noise).mean() * self.untouched.frames))


@dataclass(frozen=True)
class Calibrated:
    """A fitted plate with its model."""

    model: Model
    atlas: Atlas
    duration_s: float
    fitted: Fitted
    """As taps have turned it."""
    refined: Refined | None = None
    """What taps told."""


def fit_recording(recording: Recording, said: PlateFile, progress: Progress = lambda _stage, _share: None) -> Fitted:
    """Fit the plate that PLATE.toml describes to a recording that nobody touches; see `fit_plate` for errors.

    Of a recording with acts, those are fitted in which nobody touches.
    """
    started_s = time.monotonic()
    recording = untouched_acts(recording)
    untouched = untouched_mean(recording, said)
    fit = fit_plate(said, untouched, progress)
    return Fitted(recording, untouched, fit, time.monotonic() - started_s)


def make_model(
    fitted: Fitted,
    path: Path,
    *,
    taps: Recording | None = None,
    command: str = "",
    progress: Progress = lambda _stage, _share: None,
) -> Calibrated:
    """Make the atlas and the scan of a fitted plate, and put both in the place of the model at `path`.

    Nothing is replaced before all files are complete and load; the old model is kept, see `install`. `taps`, labelled
    roughly, settle what the untouched plate cannot tell.

    Raises CalibrationError if no tap fits the plate; OutputError if a file cannot be written.
    """
    started_s = time.monotonic()
    sha256 = digest(fitted.recording)

    def make_atlas(fitted: Fitted) -> Atlas:
        noise = fitted.noise_counts
        return make_physical_atlas(fitted.fit, noise, data_sha256=sha256, command=command, progress=progress)

    atlas, refined = make_atlas(fitted), None
    if taps is not None:
        orientation = orientation_of(atlas, taps_of(taps, atlas))
        fitted = replace(fitted, fit=turned_fit(fitted.fit, orientation))
        atlas = make_atlas(fitted) if orientation else atlas
        refined = refine(atlas, taps_of(taps, atlas), orientation, widths_of(fitted.fit), progress)
        atlas = refined.atlas
    atlas = for_fingers(atlas, fitted.fit)
    description = Description(
        name="calibrated", head="regression", domain="frequency", input="residual",
        acquisition=atlas.description.acquisition, plate=atlas.description.plate, taper=atlas.description.taper,
        data_sha256=sha256, command=command,
        scores={"expected_mm": round(fitted.fit.expected_mm, 4)},
    )  # fmt: skip
    graph = start_scan(atlas, description)
    whole, few = fitted.recording, slice(REFERENCE_FRAMES)
    reference = Recording(whole.meta, whole.frames[few], whole.sequence[few], whole.timestamp_ns[few])
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as scratch:
            fresh = Path(scratch) / path.name
            save_atlas(atlas, atlas_path(fresh))
            write(fresh.with_suffix(".untouched.npz"), reference)
            put_model(graph.SerializeToString(), fresh)
            model = install(fresh, path)
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror})", str(path), "check the folder and its space"
        ) from error
    return Calibrated(model, atlas, time.monotonic() - started_s, fitted, refined)


def write_calibration_report(fitted: Fitted, made: Calibrated | None, path: Path) -> Path:
    """Write the report beside a model, and return its folder.

    Of a poor fit without a model the folder has a name of its own: the report of the model that stays is kept.
    """
    pictures = {"response.png": draw_response(fitted), "residual.png": draw_residual(fitted)}
    error_mm = None
    if made is not None:
        told = (made.refined.placed_mm, made.refined.scatter_mm) if made.refined else ()
        error_mm = ErrorMap(made.atlas, made.fitted.noise_counts, widths_of(made.fitted.fit), GRID).after(*told)
        picture = draw_expected(fitted.fit.plate, {"": (error_mm, fitted.fit.layout.centres_mm)})
        for each in fitted.fit.layout.scatterers:
            picture.axes[0].plot(*each.at_mm, "x", color="white", markersize=10, markeredgewidth=2)
        pictures["expected-error.png"] = picture
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
    fit, a = fitted.fit, fitted.fit.acquisition
    hz = np.fft.rfftfreq(fit.measured.shape[1], 1 / a.sample_rate_hz)
    spectrum = np.abs(np.fft.rfft(fit.measured - fit.fitted, axis=1)) ** 2
    energy = (np.abs(np.fft.rfft(fit.measured, axis=1)) ** 2).sum(axis=1, keepdims=True)
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for channel, left in enumerate(spectrum / np.maximum(energy, np.finfo(float).tiny)):
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
