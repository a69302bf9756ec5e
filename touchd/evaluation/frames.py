"""Touched frames one by one: their features, the fingers on the plate, and what a finder makes of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from touchd.config import TrackerSettings
from touchd.errors import RecordingValues
from touchd.evaluation.matching import Seen
from touchd.evaluation.truth import fingers_only
from touchd.features import Domain, make_features
from touchd.model import Model
from touchd.recording import Recording
from touchd.tracker import Touch
from touchd.training.dataset import baseline_frames, residual_of

Array = NDArray[np.float32]

Find = Callable[[Array], Sequence[Touch]]
"""Takes the features of one frame, shape (inputs,), and returns the touches found in it, in any order."""


@dataclass(frozen=True, slots=True)
class TouchedFrames:
    """n frames in which something touches the plate, by k fingers at most or by something else."""

    features: Array
    """Shape (n, inputs): of the residual, as the daemon would compute them, or of the frame itself."""
    true_mm: Array
    """Shape (n, k, 2), NaN where a finger is not touching."""
    force_n: Array | None
    """Shape (n, k), NaN where unknown or not touching."""
    untouched_norm: float
    """Median length of the features of the untouched plate."""

    def __len__(self) -> int:
        return len(self.features)

    @property
    def fingers(self) -> NDArray[np.int64]:
        """How many touch in each frame, shape (n,)."""
        return np.asarray(np.isfinite(self.true_mm[:, :, 0]).sum(axis=1))


def touched_frames(recording: Recording, domain: Domain, *, residual: bool = True) -> TouchedFrames:
    """Return the touched frames of a labelled recording, each against the untouched frames beside it.

    Raises
    ------
    RecordingValues
        If there is no touched or no untouched frame, or the truth lies outside the plate.
    """
    truth = recording.contacts_mm
    assert truth is not None  # the verb has seen it
    _check_inside(recording, truth)
    touching = np.isfinite(truth[:, :, 0]).any(axis=1)
    touched, untouched = np.flatnonzero(touching), np.flatnonzero(~touching)
    for frames, name in ((touched, "touched"), (untouched, "untouched")):
        if not len(frames):
            raise RecordingValues(f"no {name} frame", "contacts_mm", "record touches, and untouched frames beside them")
    pairs = baseline_frames(recording.timestamp_ns, touched, untouched)
    extractor = make_features(domain, recording.acquisition)
    features = np.empty((len(touched), extractor.size), np.float32)
    plain = np.empty_like(features)
    for i, frame in enumerate(touched):
        baseline = recording.frames[pairs[i]].mean(axis=0, dtype=np.float32)
        counts = recording.frames[frame]
        extractor.extract(residual_of(counts, baseline) if residual else counts.astype(np.float32), features[i])
        extractor.extract(baseline, plain[i])
    fingers = fingers_only(recording).contacts_mm
    assert fingers is not None
    force_n = recording.force_n[touched] if recording.force_n is not None else None
    return TouchedFrames(features, fingers[touched], force_n, float(np.median(np.linalg.norm(plain, axis=1))))


def see(find: Find, frames: TouchedFrames) -> list[Seen]:
    """Return what a finder makes of each frame, asked one by one as the daemon asks."""
    seen = []
    for i, features in enumerate(frames.features):
        down = np.isfinite(frames.true_mm[i, :, 0])
        places_mm = [(x_mm, y_mm) for x_mm, y_mm in frames.true_mm[i, down].tolist()]
        force_n = frames.force_n[i, down].tolist() if frames.force_n is not None else None
        seen.append(Seen(places_mm, tuple(find(features)), force_n))
    return seen


def network_finder(model: Model, frames: TouchedFrames) -> Find:
    """Return the finder that a network is: one touch, always, as it knows nothing but single fingers.

    Its force is the length of the residual's features against the untouched plate's, on the daemon's default scale;
    unknown (NaN) for a network that does not take the residual.
    """
    of_residual = model.description.input == "residual"
    full = frames.untouched_norm * TrackerSettings().force_full_scale

    def find(features: Array) -> Sequence[Touch]:
        model.features[0] = features
        x_mm, y_mm, sigma_mm, confidence, key = model.estimate()
        force = min(1.0, float(np.linalg.norm(features)) / full) if of_residual and full else nan
        return (Touch(x_mm, y_mm, sigma_mm, confidence, force, key),)

    return find


def _check_inside(recording: Recording, truth: Array) -> None:
    plate = recording.meta.plate
    outside = ((truth < 0) | (truth > np.array([plate.width_mm, plate.height_mm]))).any(axis=2)
    if outside.any():
        x_mm, y_mm = truth[outside][0]
        raise RecordingValues(
            f"{outside.sum()} touches lie outside the plate of {plate.width_mm:g} x {plate.height_mm:g} mm, the first "
            f"at ({x_mm:.1f}, {y_mm:.1f})",
            "contacts_mm",
            "correct the truth or the plate's size",
        )
