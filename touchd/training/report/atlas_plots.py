"""Plots of a field atlas: signal and field error by frequency, misfit over the plate, dispersion."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from touchd.evaluation.plots.maps import MAP
from touchd.evaluation.plots.session import COLOURS, TRUTH, draw_transducers
from touchd.localization.atlas import Atlas
from touchd.localization.features import band_bins
from touchd.recording.data import Meta
from touchd.training.field.dispersion import Dispersion
from touchd.training.field.make_atlas import Calibration, Trial


def draw_bins(atlas: Atlas, calibration: Calibration) -> Figure:
    """Plot the signal and the field error of a touch relative to the noise, by frequency."""
    d = atlas.description
    a = d.acquisition
    band, kept = band_bins(a), np.array(d.bins)
    spacing_khz = a.sample_rate_hz / a.samples / 1e3
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.add_subplot()
    snr_db = 10 * np.log10(np.maximum(calibration.snr, 1e-3))
    missed_db = 10 * np.log10(np.maximum(calibration.missed, 1e-3))
    for left_out in np.setdiff1d(band, kept):
        axes.axvspan((left_out - 0.5) * spacing_khz, (left_out + 0.5) * spacing_khz, color="#e8eaed", lw=0, zorder=-1)
    axes.plot(band * spacing_khz, snr_db, "o-", color=COLOURS[0], ms=3, lw=1.4, label="touch")
    axes.plot(kept * spacing_khz, missed_db, "s-", color=COLOURS[1], ms=3, lw=1.4, label="field error")
    axes.axhline(0, color=TRUTH, lw=3, zorder=0, label="noise of a residual")
    axes.set(xlabel="frequency (kHz)", ylabel="power over noise (dB)", title="bins; grey: omitted")
    axes.set_ylim(bottom=max(-25.0, min(snr_db.min(), missed_db.min()) - 3))
    axes.legend(frameon=False)
    axes.grid(alpha=0.25)
    return figure


def draw_misfit(trial: Trial, meta: Meta) -> Figure:
    """Plot the unexplained share of each test touch's energy at its true position."""
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axes = figure.add_subplot()
    misfit = 100 * trial.placed.misfit
    order = np.argsort(misfit)  # draw the worst last, on top
    x_mm, y_mm = trial.judged.true_mm[order].T
    image = axes.scatter(x_mm, y_mm, c=misfit[order], s=16, cmap=MAP, vmin=0, vmax=float(np.percentile(misfit, 98)))
    figure.colorbar(image, ax=axes, label="unexplained energy (%)", extend="max", shrink=0.85)
    axes.set(
        xlabel="x (mm)", ylabel="y (mm)", xlim=(0, meta.plate.width_mm), ylim=(meta.plate.height_mm, 0), aspect="equal",
        title=f"misfit of {len(misfit)} touches, median {np.median(misfit):.2g} %",
    )  # fmt: skip
    draw_transducers(meta, axes)
    if meta.receivers_mm or meta.emitter_mm:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=2, frameon=False)
    return figure


def draw_dispersion(dispersion: Dispersion, material: str) -> Figure:
    """Plot the wavenumber by frequency: of the material, or fitted, with the bins used for the fit."""
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.add_subplot()
    label = "power law fitted to all bins" if dispersion.fitted else f"Mindlin plate of {material}"
    axes.plot(dispersion.frequency_hz / 1e3, 1e3 * dispersion.wavenumber_per_mm, color=COLOURS[0], lw=1.8, label=label)
    if dispersion.single_hz is not None and dispersion.single_per_mm is not None:
        axes.plot(
            dispersion.single_hz / 1e3, 1e3 * dispersion.single_per_mm, "o", color=COLOURS[1], label="best of one bin"
        )
    axes.set(xlabel="frequency (kHz)", ylabel="wavenumber (rad/m)", title="dispersion of the plate's flexural wave")
    wavelength = axes.secondary_yaxis("right", functions=(_wavelength_mm, _wavelength_mm))
    wavelength.set_ylabel("wavelength (mm)")
    axes.legend(frameon=False)
    axes.grid(alpha=0.25)
    return figure


def _wavelength_mm(wavenumber_rad_m: ArrayLike) -> NDArray[np.float64]:
    found: NDArray[np.float64] = 2e3 * np.pi / np.maximum(np.asarray(wavenumber_rad_m, float), 1e-9)
    return found
