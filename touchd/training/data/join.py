"""Join several recordings of one plate and acquisition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from touchd.errors import TrainingError
from touchd.frame import impossible_lengths
from touchd.recording.data import Act, Recording
from touchd.recording.format import join as join_chunks

APART_NS = 3_600_000_000_000
"""Gap of one hour between recordings, so that no touch is compared with another recording's untouched frames."""


def join(recordings: Sequence[Recording], names: Sequence[str]) -> Recording:
    """Concatenate recordings, an hour apart; `names` identify them in an error.

    Of the true contacts their places alone are kept. Raises TrainingError if acquisitions, plates or transducers
    differ, a plate has an impossible length, or a recording has no labels.
    """
    first = recordings[0]
    for recording, name in zip(recordings, names, strict=True):
        if recording.contacts_mm is None:
            raise TrainingError("the recording has no `contacts_mm`", name, "record with the touches' true positions")
        plate = recording.meta.plate
        for key, what in impossible_lengths(*plate.size_mm, plate.thickness_mm):
            raise TrainingError(
                what,
                f"{name}: meta.plate.{key}",
                "write the plate's own there, in mm; docs/formats.md shows how",
            )
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
    parts: list[Recording] = []
    acts: list[Act] = []
    before = number = offset_ns = 0
    for recording, labels in zip(recordings, truth, strict=True):
        acts += [
            act.model_copy(update={"begin": act.begin + before, "end": act.end + before}) for act in recording.meta.acts
        ]
        padding = ((0, 0), (0, fingers - labels.shape[1]), (0, 0))
        sequence, t_ns = recording.sequence - recording.sequence[0] + number, recording.timestamp_ns + offset_ns
        padded = np.pad(labels, padding, constant_values=np.nan)
        parts.append(Recording(first.meta, recording.frames, sequence, t_ns, padded))
        before, number, offset_ns = before + len(sequence), int(sequence[-1]) + 1, int(t_ns[-1]) + APART_NS
    return replace(join_chunks(parts), meta=first.meta.model_copy(update={"acts": tuple(acts)}))


def _settings(recording: Recording) -> dict[str, object]:
    meta = recording.meta
    return dict(recording.acquisition) | {
        "plate": meta.plate, "emitter_mm": meta.emitter_mm, "receivers_mm": meta.receivers_mm
    }  # fmt: skip
