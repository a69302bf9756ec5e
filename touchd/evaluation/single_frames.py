"""Score single touched frames: each frame's baseline and residual, true fingers, and the touches found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import Settings
from touchd.detection.detection import Detection
from touchd.detection.hum import Hum
from touchd.detection.impulses import Impulses
from touchd.errors import RecordingValues
from touchd.evaluation.dataset import baseline_frames, beyond, noise_energy, noise_of, residual_of
from touchd.evaluation.matching import Seen, seen_in
from touchd.evaluation.truth import fingers_only
from touchd.frame import Counts
from touchd.localization.atlas import Atlas
from touchd.localization.atlas_localizer import AtlasLocalizer
from touchd.localization.features import Features
from touchd.localization.localization import Localizer
from touchd.localization.model import Model
from touchd.localization.network_localizer import NetworkLocalizer
from touchd.localization.noise import MEMORY_FRAMES
from touchd.outcome import Outcome
from touchd.recording.data import Recording
from touchd.touch import Touch

Array = NDArray[np.float32]


Find = Callable[[int], Sequence[Touch]]
"""Finds the touches of the i-th touched frame, in any order, without knowledge of earlier frames."""


@dataclass(frozen=True, slots=True)
class TouchedFrames:
    """n touched frames of a recording with at most k fingers; a frame may also hold a palm or water."""

    recording: Recording
    """With labels of fingers only."""
    touched: NDArray[np.int64]
    """Indices of the touched frames, shape (n,)."""
    beside: NDArray[np.int64]
    """Indices of the two untouched frames whose mean is the baseline, shape (n, 2)."""

    def __len__(self) -> int:
        return len(self.touched)

    @property
    def true_mm(self) -> Array:
        """Positions, shape (n, k, 2), NaN for a finger that is up."""
        assert self.recording.contacts_mm is not None
        return np.asarray(self.recording.contacts_mm[self.touched])

    @property
    def fingers(self) -> NDArray[np.int64]:
        """Number of fingers in each frame, shape (n,)."""
        return np.asarray(np.isfinite(self.true_mm[:, :, 0]).sum(axis=1))

    def baseline(self, i: int) -> Array:
        """Return the baseline of frame i, shape (channels, samples)."""
        return np.asarray(self.recording.frames[self.beside[i]].mean(axis=0, dtype=np.float32))

    def noise_energy(self) -> float:
        """Return the noise energy of a residual, ADC counts squared."""
        a = self.recording.acquisition
        return noise_energy(noise_of(self.recording.frames[np.unique(self.beside)], a), a)

    def look(self, i: int) -> tuple[Counts, Array, Array]:
        """Return frame i, its baseline and the difference, each of shape (channels, samples), ADC counts."""
        counts, baseline = self.recording.frames[self.touched[i]], self.baseline(i)
        return counts, baseline, residual_of(counts, baseline)


def touched_frames(recording: Recording) -> TouchedFrames:
    """Collect the touched frames of a labelled recording and the untouched frames beside each.

    Raises RecordingValues if the recording lacks touched or untouched frames, or a true position lies outside the
    plate.
    """
    truth = recording.contacts_mm
    assert truth is not None  # checked by the caller
    if outside := beyond(truth.reshape(-1, 2), recording.meta.plate):
        raise RecordingValues(outside, "contacts_mm", "correct the positions or the plate's size")
    touching = np.isfinite(truth[:, :, 0]).any(axis=1)
    touched, untouched = np.flatnonzero(touching), np.flatnonzero(~touching)
    for frames, name in ((touched, "touched"), (untouched, "untouched")):
        if not len(frames):
            raise RecordingValues(f"no {name} frame", "contacts_mm", "record touches, and untouched frames beside them")
    return TouchedFrames(fingers_only(recording), touched, baseline_frames(recording.timestamp_ns, touched, untouched))


def find_with(model: Model, atlas: Atlas | None, frames: TouchedFrames, settings: Settings | None = None) -> Find:
    """Return the daemon's localizer as a function of single frames, each of them a touch-down.

    The baseline is the mean of two untouched frames, so a residual has 1.5 times the noise power of a frame. The noise
    model gets differences of these two frames, scaled from twice that power. A network without an atlas locates one
    finger in every frame, at any confidence.
    """
    always = {"min_confidence": 0, "keep_confidence": 0, "max_sigma_mm": 1e9, "min_snr_db": 0}
    localizer: Localizer
    if atlas is None:
        localizer = NetworkLocalizer(model, Settings.model_validate({"model": always}), None)
    else:
        localizer = AtlasLocalizer(model, atlas, settings or Settings(), None)
    acquisition, counts = frames.recording.acquisition, frames.recording.frames
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), MEMORY_FRAMES)).astype(int).tolist()
    pairs = [counts[frames.beside[i]].astype(np.float32) for i in chosen]
    noise = [(one - other) * np.float32(sqrt(3) / 2) for one, other in pairs if (one != other).any()]
    hum, impulses = Hum(acquisition), Impulses(acquisition)
    if noise:
        hum.learn(residuals := np.array(noise))
        hit = impulses.learn(residuals)
        localizer.update(frames.baseline(0), residuals[~hit])
    noise_root, live = float(np.cbrt(frames.noise_energy())), np.ones(acquisition.channels, bool)

    def find(i: int) -> Sequence[Touch]:
        counts, baseline, residual = frames.look(i)
        if hum.known:
            hum.remove(residual)
        hits = impulses.blank(residual, float(np.square(residual).sum()))
        energy = float(np.square(residual, dtype=np.float64).sum())
        detection = Detection(
            Outcome.TOUCHED, 0, energy, noise_root, 0.0, counts.astype(np.float32), residual, baseline, live, hits=hits
        )
        localizer.update(baseline)
        return localizer.localize(detection, alive=False, complete=True).touches

    return find


def network_features(model: Model, frames: TouchedFrames) -> Array:
    """Return the network's features of each frame, shape (n, inputs)."""
    d = model.description
    extract = Features(d.domain, frames.recording.acquisition, taper=d.taper).extract
    features = np.empty((len(frames), d.inputs), np.float32)
    of_residual = d.input == "residual"
    for i, row in enumerate(features):
        counts, _, residual = frames.look(i)
        extract(residual if of_residual else counts.astype(np.float32), row)
    return features


def see(find: Find, frames: TouchedFrames) -> list[Seen]:
    """Find the touches of each frame, one frame at a time as the daemon does."""
    return [seen_in(frames.recording, at, find(i)) for i, at in enumerate(frames.touched)]
