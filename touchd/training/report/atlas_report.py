"""The report beside a field atlas: a folder with a page and pictures, there whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from touchd import __version__
from touchd.evaluation.plots.maps import draw_maps
from touchd.evaluation.plots.model import draw_sigma
from touchd.localization.features import band_bins
from touchd.recording.data import Meta
from touchd.training.report.atlas_plots import draw_bins, draw_dispersion, draw_misfit
from touchd.training.report.network_report import duration, findings_of, score_row, write_folder
from touchd.training.train_atlas import AtlasResult


def write_atlas_report(result: AtlasResult, meta: Meta, names: list[str]) -> Path:
    """Write the report of an atlas into its folder, in place of an older one, and return the folder.

    Raises
    ------
    OutputError
        If it cannot be written; an older report is then left as it was.
    """
    judged = result.trial.judged
    pictures: dict[str, Figure] = {
        "maps.png": draw_maps(judged, meta),
        "misfit.png": draw_misfit(result.trial, meta),
        "sigma.png": draw_sigma(judged),
        "bins.png": draw_bins(result.atlas, result.calibration),
        "dispersion.png": draw_dispersion(result.dispersion, meta.plate.material),
    }
    return write_folder(result.path, pictures, lambda: atlas_page(result, names, list(pictures)))


def atlas_page(result: AtlasResult, names: list[str], pictures: list[str]) -> str:
    """Return the report's text, in Markdown."""
    d, parts, learned = result.atlas.description, result.parts, result.learned
    rows, columns, size = result.atlas.coefficients.shape
    plate = d.plate
    lines = [
        f"# {result.path.name}",
        "",
        f"Field atlas beside `{result.model.path.name}`, for a {plate.material} plate of {plate.width_mm:g} x "
        f"{plate.height_mm:g} x {plate.thickness_mm:g} mm: {rows} x {columns} nodes of {size} numbers, "
        f"{d.step_mm:g} mm apart.",
        "",
        *(f"- {line}" for line in [*findings_of(result.trial.judged, plate), *_findings(result)]),
        "",
        "## Warnings",
        "",
        *([f"- {note}" for note in result.notes] or ["None."]),
        "",
        "## Scores",
        "",
        "From the network's answer on, as the daemon starts when a finger comes down.",
        "",
        "| score | | | meaning |",
        "|---|---|---|---|",
        *(score_row(name, value) for name, value in result.scores.items()),
        "",
        "## Standard error",
        "",
        "Of the validation touches as they were recorded, and with white noise added: share of errors within the "
        "predicted standard error (68 % if it is right).",
        "",
        "| noise below the untouched plate | within sigma | median error |",
        "|---|---|---|",
        *(f"| {db:.0f} dB | {100 * within:.0f} % | {mm:.3f} mm |" for db, within, mm in result.calibration.within),
        "",
        *(line for name in pictures for line in (f"![{name.removesuffix('.png')}]({name})", "")),
        "## How it was made",
        "",
        f"- `{d.command}`" if d.command else "- by a program",
        f"- recordings: {', '.join(names)}; SHA-256 of frames and truth {d.data_sha256}",
        f"- {len(parts.train)} touches for training, {len(parts.validation)} for validation, {len(parts.test)} for the "
        f"test; seed {d.seed}",
        f"- chosen by leaving touches out: ridge {learned.prior.ridge:g} of the signal beside the noise, white share "
        f"{learned.prior.white_share:g}",
        f"- noise_scale {d.noise_scale:.2f}, field_scale {d.field_scale:.2f}",
        f"- {duration(result.duration_s)}; touchd {__version__}",
        "",
    ]
    return "\n".join(lines)


def _findings(result: AtlasResult) -> list[str]:
    """Return what to make of the atlas' own figures, a sentence each."""
    d, calibration, learned = result.atlas.description, result.calibration, result.learned
    start_mm = np.linalg.norm(result.trial.start_mm - result.trial.judged.true_mm, axis=1)
    found = [
        f"The network alone: half of them within {np.median(start_mm):.2f} mm, 95 % within "
        f"{np.percentile(start_mm, 95):.2f} mm.",
        f"{len(d.bins)} of {len(band_bins(d.acquisition))} bins are kept; the others hold 1 % of what is heard of a "
        f"touch. That takes the median error of the validation touches from {calibration.whole_mm:.4f} to "
        f"{calibration.kept_mm:.4f} mm.",
    ]
    if learned.label_noise_mm:
        found.append(
            f"The positions of the touches are off by about {learned.label_noise_mm:.2f} mm per axis themselves. Those "
            "of the training part were corrected; the scores above are against the test part's as they are, so they "
            "flatter nothing: the atlas is better than they say. The share within the standard error, which knows "
            "nothing of the labels' own errors, counts them as the atlas'."
        )
    if d.fitted:
        low, high = d.wavenumber_rad_m[0], d.wavenumber_rad_m[-1]
        found.append(
            f"The plate's material is unknown: its wavenumber was fitted to the touches, {low:.0f} to {high:.0f} rad/m "
            "along the band."
        )
    return found
