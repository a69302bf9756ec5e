"""Extract the true touches from a recording's labels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from touchd.recording.data import Recording

STILL_MM_S = 5.0
"""Fingers below this speed are still, mm/s."""


@dataclass(frozen=True, slots=True)
class TrueTouch:
    """One touch: a run of frames of one finger."""

    start_s: float
    """Time of its first frame."""
    moving: NDArray[np.bool_]
    """Whether the finger moves in each frame, shape (n,)."""
    frames: NDArray[np.int64]
    """Sequence numbers, shape (n,)."""
    position_mm: NDArray[np.float32]
    """Shape (n, 2)."""


def fingers_only(recording: Recording) -> Recording:
    """Remove the labels of palms and drops; contacts found there then count as ghosts.

    The twin labels them with a position but no force; in other recordings an unknown force means nothing, and the act
    tells a palm.
    """
    truth, force_n = recording.contacts_mm, recording.force_n
    if truth is None:
        return recording
    none = np.repeat(recording.during("palm")[:, None], truth.shape[1], axis=1)
    if force_n is not None and recording.meta.source == "simulated":
        none |= ~np.isfinite(force_n)
    if not none.any():
        return recording
    return replace(recording, contacts_mm=np.where(none[..., None], np.float32(np.nan), truth))


def rough_frames(recording: Recording) -> set[int]:
    """Return the sequence numbers of frames whose labels tell that a finger is down, but hardly where."""
    return set(recording.sequence[recording.during("stroke", "thumb")].tolist())


def true_touches(recording: Recording) -> list[TrueTouch]:
    """Return a recording's true touches, ordered by first frame."""
    if recording.contacts_mm is None:
        return []
    touches: list[TrueTouch] = []
    for finger in range(recording.contacts_mm.shape[1]):
        position_mm = recording.contacts_mm[:, finger]
        down = np.isfinite(position_mm[:, 0])
        moving = _moving(position_mm, recording.timestamp_ns)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], down, [False]])))
        for first, after in edges.reshape(-1, 2):
            run = slice(first, after)
            start_s = float(recording.timestamp_ns[first]) * 1e-9
            touches.append(TrueTouch(start_s, moving[run], recording.sequence[run], position_mm[run]))
    return sorted(touches, key=lambda touch: int(touch.frames[0]))


def _moving(position_mm: NDArray[np.float32], timestamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether a finger is faster than `STILL_MM_S` in each frame, shape (n,)."""
    moving = np.zeros(len(position_mm), bool)
    if len(position_mm) > 1:
        speed_mm_s = np.linalg.norm(np.diff(position_mm, axis=0), axis=1) / (np.diff(timestamp_ns) * 1e-9)
        fast = np.nan_to_num(speed_mm_s) > STILL_MM_S
        moving[1:] |= fast
        moving[:-1] |= fast
    return moving
