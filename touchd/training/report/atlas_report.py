"""Write the report beside a field atlas: a folder with a page and plots, replaced as a whole."""

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
from touchd.training.report.template import render
from touchd.training.train_atlas import AtlasResult

TEMPLATE = Path(__file__).with_name("atlas_report.md.j2")


def write_atlas_report(result: AtlasResult, meta: Meta, names: list[str]) -> Path:
    """Write the report of an atlas into its folder, and return the folder; see `write_folder`."""
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
    d = result.atlas.description
    start_mm = np.linalg.norm(result.trial.start_mm - result.trial.judged.true_mm, axis=1)
    return render(
        TEMPLATE, result=result, d=d, parts=result.parts, names=names, plots=pictures, version=__version__,
        shape=result.atlas.coefficients.shape, band=len(band_bins(d.acquisition)),
        findings=findings_of(result.trial.judged, d.plate), start_mm=np.percentile(start_mm, (50, 95)).tolist(),
        scores=[score_row(*score) for score in result.scores.items()], duration=duration(result.duration_s),
    )  # fmt: skip
