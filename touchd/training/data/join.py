"""Join several recordings of one plate and acquisition."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from touchd.errors import TrainingError
from touchd.recording.data import Act, Recording

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
        settings = _settings(recording)
        for what, value in _settings(first).items():
            if value != settings[what]:
                raise TrainingError(
                    f"mixed acquisitions: {what} is {value} in {names[0]}, but {settings[what]} here",
                    name,
                    "train a model on each, or record again with equal settings",
                )
    if len(recordings) == 1:
        return first
    truth = [recording.contacts_mm for recording in recordings if recording.contacts_mm is not None]
    fingers = max(each.shape[1] for each in truth)
    sequence: list[NDArray[np.int64]] = []
    time_ns: list[NDArray[np.int64]] = []
    acts: list[Act] = []
    last = offset_ns = 0
    for recording in recordings:
        before = sum(len(each) for each in sequence)
        acts += [
            act.model_copy(update={"begin": act.begin + before, "end": act.end + before}) for act in recording.meta.acts
        ]
        sequence.append(recording.sequence - recording.sequence[0] + last)
        time_ns.append(recording.timestamp_ns + offset_ns)
        last, offset_ns = int(sequence[-1][-1]) + 1, int(time_ns[-1][-1]) + APART_NS
    return Recording(
        meta=first.meta.model_copy(update={"acts": tuple(acts)}),
        frames=np.concatenate([recording.frames for recording in recordings]),
        sequence=np.concatenate(sequence),
        timestamp_ns=np.concatenate(time_ns),
        contacts_mm=np.concatenate([
            np.pad(each, ((0, 0), (0, fingers - each.shape[1]), (0, 0)), constant_values=np.nan) for each in truth
        ]),
    )  # fmt: skip


def _settings(recording: Recording) -> dict[str, object]:
    meta = recording.meta
    return dict(recording.acquisition) | {
        "plate": meta.plate, "emitter_mm": meta.emitter_mm, "receivers_mm": meta.receivers_mm
    }  # fmt: skip
