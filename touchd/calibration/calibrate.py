"""From an untouched recording to a model: fit the plate, make its atlas and its scan, write both with a reference."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from touchd.calibration.physical_atlas import make_physical_atlas
from touchd.calibration.place_correction import widths_of
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.plate_fit import PlateFit, Progress, fit_plate
from touchd.calibration.start_scan import start_scan
from touchd.calibration.taps import Refined, orientation_of, refine, taps_of, turned_fit
from touchd.calibration.untouched import Untouched, untouched_acts, untouched_mean
from touchd.errors import OutputError
from touchd.evaluation.dataset import digest
from touchd.localization.atlas import Atlas, atlas_path, save_atlas
from touchd.localization.model import Description, Model
from touchd.localization.model_file import install, put_model
from touchd.recording.data import Recording
from touchd.recording.format import write

REFERENCE_FRAMES = 100
"""Frames kept beside the model, with which `touchd doctor` compares the plate."""


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
        refined = refine(atlas, taps_of(taps, atlas), orientation, widths_of(fitted.fit))
        atlas = refined.atlas
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
