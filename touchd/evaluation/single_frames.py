"""Score single touched frames: each frame's baseline and residual, true fingers, and the touches found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.errors import RecordingValues
from touchd.evaluation.dataset import baseline_frames, noise_energy, noise_of, residual_of
from touchd.evaluation.matching import Seen
from touchd.evaluation.truth import fingers_only
from touchd.frame import Acquisition, Counts
from touchd.recording.data import Recording
from touchd.touch import Touch

Array = NDArray[np.float32]


class Look(NamedTuple):
    """A touched frame with its baseline, each of shape (channels, samples), ADC counts."""

    counts: Counts
    baseline: Array
    residual: Array
    """Counts less baseline."""


Find = Callable[[Look], Sequence[Touch]]
"""Finds the touches of one frame, in any order, without knowledge of earlier frames."""


@dataclass(frozen=True, slots=True)
class TouchedFrames:
    """n touched frames with at most k fingers; a frame may also hold a palm or water."""

    acquisition: Acquisition
    counts: Counts
    """All frames of the recording, shape (m, channels, samples)."""
    touched: NDArray[np.int64]
    """Indices of the touched frames, shape (n,)."""
    beside: NDArray[np.int64]
    """Indices of the two untouched frames whose mean is the baseline, shape (n, 2)."""
    true_mm: Array
    """Positions, shape (n, k, 2), NaN for a finger that is up."""
    force_n: Array | None
    """Forces, shape (n, k), NaN if unknown or up."""

    def __len__(self) -> int:
        return len(self.touched)

    @property
    def fingers(self) -> NDArray[np.int64]:
        """Number of fingers in each frame, shape (n,)."""
        return np.asarray(np.isfinite(self.true_mm[:, :, 0]).sum(axis=1))

    def baseline(self, i: int) -> Array:
        """Return the baseline of frame i, shape (channels, samples)."""
        return np.asarray(self.counts[self.beside[i]].mean(axis=0, dtype=np.float32))

    def noise_energy(self) -> float:
        """Return the noise energy of a residual, ADC counts squared."""
        return noise_energy(noise_of(self.counts[np.unique(self.beside)]), self.acquisition)

    def look(self, i: int) -> Look:
        """Return frame i with its baseline and residual."""
        counts, baseline = self.counts[self.touched[i]], self.baseline(i)
        return Look(counts, baseline, residual_of(counts, baseline))


def touched_frames(recording: Recording) -> TouchedFrames:
    """Collect the touched frames of a labelled recording and the untouched frames beside each.

    Raises
    ------
    RecordingValues
        The recording lacks touched or untouched frames, or a true position lies outside the plate.
    """
    truth = recording.contacts_mm
    assert truth is not None  # checked by the caller
    _check_inside(recording, truth)
    touching = np.isfinite(truth[:, :, 0]).any(axis=1)
    touched, untouched = np.flatnonzero(touching), np.flatnonzero(~touching)
    for frames, name in ((touched, "touched"), (untouched, "untouched")):
        if not len(frames):
            raise RecordingValues(f"no {name} frame", "contacts_mm", "record touches, and untouched frames beside them")
    fingers = fingers_only(recording).contacts_mm
    assert fingers is not None
    return TouchedFrames(
        acquisition=recording.acquisition,
        counts=recording.frames,
        touched=touched,
        beside=baseline_frames(recording.timestamp_ns, touched, untouched),
        true_mm=fingers[touched],
        force_n=recording.force_n[touched] if recording.force_n is not None else None,
    )


def see(find: Find, frames: TouchedFrames) -> list[Seen]:
    """Find the touches of each frame, one frame at a time as the daemon does."""
    seen = []
    for i in range(len(frames)):
        down = np.isfinite(frames.true_mm[i, :, 0])
        positions_mm = [(x_mm, y_mm) for x_mm, y_mm in frames.true_mm[i, down].tolist()]
        force_n = frames.force_n[i, down].tolist() if frames.force_n is not None else None
        seen.append(Seen(positions_mm, tuple(find(frames.look(i))), force_n))
    return seen


def _check_inside(recording: Recording, truth: Array) -> None:
    plate = recording.meta.plate
    outside = ((truth < 0) | (truth > np.array([plate.width_mm, plate.height_mm]))).any(axis=2)
    if outside.any():
        x_mm, y_mm = truth[outside][0]
        raise RecordingValues(
            f"{outside.sum()} touches lie outside the plate of {plate.width_mm:g} x {plate.height_mm:g} mm, the first "
            f"at ({x_mm:.1f}, {y_mm:.1f})",
            "contacts_mm",
            "correct the positions or the plate's size",
        )
