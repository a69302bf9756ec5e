"""Write the report beside a model or an atlas: a folder with a page and plots, replaced as a whole."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from touchd import __version__
from touchd.errors import OutputError
from touchd.evaluation.model_scores import Judgement
from touchd.evaluation.plots.maps import draw_error_map, draw_maps, draw_zones
from touchd.evaluation.plots.model import draw_confusion, draw_learning_curve, draw_sigma
from touchd.evaluation.plots.session import save
from touchd.frame import Plate
from touchd.localization.features import band_bins
from touchd.recording.data import Meta
from touchd.training.report.template import render

if TYPE_CHECKING:  # a report needs no torch
    from touchd.training.train_atlas import AtlasResult
    from touchd.training.train_network import Result

PAGE = "report.md"
TEMPLATE = Path(__file__).with_name("report.md.j2")
EDGE_SHARE = 0.1
"""Share of the touched rectangle's sides that counts as near the edge."""
UNITS = {"n": "touches", "accuracy": "%", "within_sigma": "%", "confident": "%", "key_to_key_errors": "touches"}
MEANINGS = {
    "n": "touches of the test part, unseen in training",
    "rmse_mm": "root of the mean squared distance from the true position",
    "mean_mm": "mean distance",
    "sd_mm": "standard deviation of the distance",
    "median_mm": "median distance",
    "p95_mm": "95th percentile of the distance",
    "max_mm": "largest distance",
    "within_sigma": "errors per axis within the predicted standard error; 68 % if exact",
    "confident": "touches with a confidence of 0.5 or more",
    "accuracy": "touches in the right class",
    "key_to_key_errors": "touches of a key assigned to another key",
}


def report_folder(model: Path) -> Path:
    """Return the folder of a model's report: `plate.report` for `plate.onnx`."""
    return model.with_suffix(".report")


def write_report(result: Result, meta: Meta, names: list[str]) -> Path:
    """Write the report of a trained model into its folder, and return the folder; see `write_folder`."""
    judged, d, curve = result.judged, result.model.description, result.curve
    pictures = {"learning-curve.png": draw_learning_curve(curve.loss, curve.validation_mm, curve.kept)}
    if d.head == "grid":
        pictures["zones.png"] = draw_zones(judged, d, meta)
    elif d.head == "keypad":
        pictures["confusion.png"] = draw_confusion(judged, d)
    else:
        pictures |= {"error-map.png": draw_error_map(judged, meta), "sigma.png": draw_sigma(judged)}
    text = _page(
        result, names, list(pictures), name=result.model.path.name, d=d, findings=findings(result, meta.plate),
        atlas=None,
    )  # fmt: skip
    return write_folder(result.model.path, pictures, text)


def write_atlas_report(result: AtlasResult, meta: Meta, names: list[str]) -> Path:
    """Write the report of an atlas into its folder, and return the folder; see `write_folder`."""
    pictures = {"maps.png": draw_maps(result.judged, meta), "sigma.png": draw_sigma(result.judged)}
    d = result.atlas.description
    start_mm = np.linalg.norm(result.start_mm - result.judged.true_mm, axis=1)
    text = _page(
        result, names, list(pictures), name=result.path.name, d=d, atlas=result.atlas,
        findings=findings_of(result.judged, d.plate), band=len(band_bins(d.acquisition)),
        start_mm=np.percentile(start_mm, (50, 95)).tolist(),
    )  # fmt: skip
    return write_folder(result.path, pictures, text)


def write_folder(model: Path, pictures: dict[str, Figure], text: str) -> Path:
    """Write plots and a page into a model's report folder, replacing an older report, and return the folder.

    Raises OutputError if the report cannot be written; an older report stays unchanged.
    """
    folder = report_folder(model)
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as scratch:
            fresh = Path(scratch) / "new"
            fresh.mkdir()
            for name, figure in pictures.items():
                save(figure, fresh / name)
            (fresh / PAGE).write_text(text, encoding="utf-8")
            if folder.exists():
                os.replace(folder, Path(scratch) / "old")
            os.replace(fresh, folder)
    except OSError as error:
        raise OutputError(
            f"the report cannot be written ({error.strerror or error})",
            str(folder),
            "the model is written; check folder and space, or use --no-report",
        ) from error
    return folder


def remove_report(model: Path) -> None:
    """Remove the report of an older model of this name."""
    shutil.rmtree(report_folder(model), ignore_errors=True)


def _page(result: Result | AtlasResult, names: Sequence[str], plots: Sequence[str], **values: object) -> str:
    versions = {"touchd": __version__, "torch": version("torch"), "onnxruntime": version("onnxruntime")}
    scores = [score_row(*score) for score in result.scores.items()]
    return render(
        TEMPLATE, result=result, names=names, plots=plots, scores=scores, duration=duration(result.duration_s),
        versions=versions, **values,
    )  # fmt: skip


def findings(result: Result, plate: Plate) -> list[str]:
    """Interpret the scores and the learning curve, one sentence per finding."""
    found = findings_of(result.judged, plate)
    curve = result.curve.validation_mm
    tenth = max(1, len(curve) // 10)
    if len(curve) > 10 and result.curve.kept == len(curve) and curve[-1] < 0.9 * curve[-1 - tenth]:
        found.append("The validation RMSE was still falling at the end: more epochs would help.")
    return found


def findings_of(judged: Judgement, plate: Plate) -> list[str]:
    """Interpret the estimates for the test touches, one sentence per finding."""
    if judged.true_class is not None and judged.found_class is not None:
        right = (judged.found_class == judged.true_class).mean()
        return [f"{100 * right:.1f} % of the test touches are in the right class."]
    distance_mm = judged.distance_mm
    median_mm, p95_mm = np.percentile(distance_mm, (50, 95))
    found = [f"Half of the test touches are within {median_mm:.2f} mm, 95 % within {p95_mm:.2f} mm."]
    low, high = judged.true_mm.min(axis=0), judged.true_mm.max(axis=0)
    inset = EDGE_SHARE * (high - low)
    near = ((judged.true_mm < low + inset) | (judged.true_mm > high - inset)).any(axis=1)
    if near.all() or not near.any():
        found.append("Too few touches to compare the edges with the middle.")
    else:
        edge_mm, middle_mm = (float(np.median(distance_mm[part])) for part in (near, ~near))
        how = "Worse near the edges" if edge_mm > 1.25 * middle_mm else "Similar near the edges and in the middle"
        found.append(f"{how}: median {edge_mm:.2f} mm in the outer tenth on each side, {middle_mm:.2f} mm within.")
    share = 100 * float((np.abs(judged.error_mm) <= judged.sigma_mm[:, None]).mean())
    how = "about right" if 62 <= share <= 75 else "too large" if share > 75 else "too small"
    found.append(f"The predicted standard error is {how}: {share:.0f} % of the errors are within it (68 % if exact).")
    far = int((distance_mm > 10 * median_mm).sum())
    if far:
        x_mm, y_mm = judged.true_mm[distance_mm.argmax()]
        found.append(
            f"{'1 touch is' if far == 1 else f'{far} touches are'} off by more than ten times the median, the farthest "
            f"at ({x_mm:.0f}, {y_mm:.0f}) mm of {plate.width_mm:g} x {plate.height_mm:g}."
        )
    return found


def score_row(name: str, value: float) -> str:
    """Format a score as a row of a Markdown table."""
    unit = "mm" if name.endswith("_mm") else UNITS.get(name, "")
    text = f"{100 * value:.1f}" if unit == "%" else f"{value:.0f}" if unit == "touches" else f"{value:.3f}"
    return f"| `{name}` | {text} | {unit} | {MEANINGS.get(name, '')} |"


def duration(seconds: float) -> str:
    """Format a duration in s or min."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
