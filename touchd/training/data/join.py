"""Join several recordings of one plate and acquisition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from touchd.errors import TrainingError
from touchd.recording.data import Recording

APART_NS = 3_600_000_000_000
"""Gap of one hour between recordings, so that no touch is compared with another recording's untouched frames."""


def join(recordings: Sequence[Recording], names: Sequence[str]) -> Recording:
    """Concatenate recordings, an hour apart; `names` identify them in an error.

    Arrays that a recording lacks, such as forces, are dropped.

    Raises
    ------
    TrainingError
        Acquisitions, plates or transducers differ, or a recording has no labels.
    """
    first = recordings[0]
    for recording, name in zip(recordings, names, strict=True):
        if recording.contacts_mm is None:
            raise TrainingError("the recording has no `contacts_mm`", name, "record with the touches' true positions")
        for what in ("channels", "samples", "sample_rate_hz", "bits", "full_scale_v", "chirp"):
            _check_same(what, getattr(first.acquisition, what), getattr(recording.acquisition, what), names[0], name)
        for what in ("plate", "emitter_mm", "receivers_mm"):
            _check_same(what, getattr(first.meta, what), getattr(recording.meta, what), names[0], name)
    if len(recordings) == 1:
        return first
    offset, last, arrays = 0, 0, []
    for recording in recordings:
        arrays.append((recording.sequence - recording.sequence[0] + last, recording.timestamp_ns + offset))
        last = int(arrays[-1][0][-1]) + 1
        offset = int(arrays[-1][1][-1]) + APART_NS
    fingers = max(_truth(recording).shape[1] for recording in recordings)
    return Recording(
        meta=first.meta,
        frames=np.concatenate([recording.frames for recording in recordings]),
        sequence=np.concatenate([sequence for sequence, _ in arrays]),
        timestamp_ns=np.concatenate([time_ns for _, time_ns in arrays]),
        contacts_mm=np.concatenate([_widened(_truth(recording), fingers) for recording in recordings]),
    )


def _check_same(what: str, one: Any, two: Any, first: str, other: str) -> None:
    if one != two:
        raise TrainingError(
            f"mixed acquisitions: {what} is {one} in {first}, but {two} here",
            other,
            "train a model on each, or record again with equal settings",
        )


def _truth(recording: Recording) -> np.ndarray[Any, np.dtype[np.float32]]:
    assert recording.contacts_mm is not None
    return recording.contacts_mm


def _widened(truth: np.ndarray[Any, np.dtype[np.float32]], fingers: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Pad positions (n, k, 2) with NaN to `fingers` columns."""
    missing = np.full((len(truth), fingers - truth.shape[1], 2), np.nan, np.float32)
    return np.concatenate([truth, missing], axis=1)
