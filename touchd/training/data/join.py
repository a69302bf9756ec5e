"""Several recordings of one plate, taken alike, as one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from touchd.errors import TrainingError
from touchd.recording.data import Recording

APART_NS = 3_600_000_000_000
"""An hour between two recordings, so that no touch is compared with the untouched plate of another one."""


def join(recordings: Sequence[Recording], names: Sequence[str]) -> Recording:
    """Return the recordings one after the other, an hour apart; `names` tell them apart in an error.

    What not all of them have, such as forces, is left out.

    Raises
    ------
    TrainingError
        If their acquisitions, plates or transducers differ, or one is not labelled.
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
            "train a model on each, or record again alike",
        )


def _truth(recording: Recording) -> np.ndarray[Any, np.dtype[np.float32]]:
    assert recording.contacts_mm is not None
    return recording.contacts_mm


def _widened(truth: np.ndarray[Any, np.dtype[np.float32]], fingers: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return the truth (n, k, 2) with columns of no touch up to `fingers`."""
    missing = np.full((len(truth), fingers - truth.shape[1], 2), np.nan, np.float32)
    return np.concatenate([truth, missing], axis=1)
