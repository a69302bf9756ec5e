"""Scores of a whole replay: which of the recording's touches were found, and how well."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from touchd.event import TouchEvent
from touchd.recording import Recording

NEAR_MM = 25.0
"""A contact farther than this from a touch is not that touch."""
SLACK_FRAMES = 10
"""A contact may end so many frames after its touch: release and filter take their time."""
STILL_MM_S = 5.0
"""A finger slower than this is still; a faster one moves."""


@dataclass(frozen=True, slots=True)
class TrueTouch:
    """One touch of the truth: a run of frames of one finger."""

    start_s: float
    """Time of its first frame."""
    moving: NDArray[np.bool_]
    """Whether the finger moves in each frame, shape (n,)."""
    frames: NDArray[np.int64]
    """Sequence numbers, shape (n,)."""
    position_mm: NDArray[np.float32]
    """Shape (n, 2)."""


@dataclass(slots=True)
class FoundContact:
    """One contact as the events tell it, from its first message to its last."""

    frames: list[int] = field(default_factory=list)
    position_mm: list[tuple[float, float]] = field(default_factory=list)
    downs: int = 0
    ups: int = 0


@dataclass(frozen=True, slots=True)
class StreamScores:
    """How a replay's contacts match the truth."""

    touches: int
    found: int
    """Touches with at least one contact."""
    missed: int
    ghosts: int
    """Contacts that belong to no touch."""
    split: int
    """Contacts beyond the first of a touch."""
    clean: bool
    """Whether each contact has exactly one down and one up."""
    error_mm: NDArray[np.float64]
    """Position less truth for each contact of each message, shape (n, 2)."""
    moving: NDArray[np.bool_]
    """Whether the finger was moving, for each error, shape (n,)."""
    jitter_mm: float | None
    """RMS distance of a still finger's positions from their own mean, over all touches."""
    down_latency_ms: float | None
    """Median time from a touch's first frame to that of its contact's first message."""


def true_touches(recording: Recording) -> list[TrueTouch]:
    """Return the touches of a recording's truth, in order of their first frames."""
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


def found_contacts(events: Iterable[TouchEvent]) -> list[FoundContact]:
    """Return the contacts that touch messages tell of, in order of their ids."""
    contacts: dict[int, FoundContact] = {}
    for event in events:
        for contact in event.contacts:
            found = contacts.setdefault(contact.id, FoundContact())
            found.downs += contact.phase == "down"
            found.ups += contact.phase == "up"
            if contact.phase != "up":
                found.frames.append(event.frame)
                found.position_mm.append((contact.x_mm, contact.y_mm))
    return [contacts[i] for i in sorted(contacts)]


def score_stream(recording: Recording, events: Iterable[TouchEvent]) -> StreamScores:
    """Match the contacts of a replay's touch messages with the recording's truth."""
    touches, contacts = true_touches(recording), found_contacts(events)
    seconds = dict(zip(recording.sequence.tolist(), (recording.timestamp_ns * 1e-9).tolist(), strict=True))
    owners: list[list[FoundContact]] = [[] for _ in touches]
    ghosts = 0
    for contact in contacts:
        apart = [_apart_mm(contact, touch) for touch in touches]
        matches = [(distance_mm, i) for i, distance_mm in enumerate(apart) if distance_mm is not None]
        if matches:
            owners[min(matches)[1]].append(contact)
        else:
            ghosts += 1
    pairs = [(contact, touch) for touch, owned in zip(touches, owners, strict=True) for contact in owned]
    together = [_together(contact, touch) for contact, touch in pairs]
    firsts = [(owned[0], touch) for touch, owned in zip(touches, owners, strict=True) if owned]
    latency_ms = [1e3 * (seconds[contact.frames[0]] - touch.start_s) for contact, touch in firsts]
    wander_mm = [_wander_mm(contact, touch) for contact, touch in pairs]
    square_mm = np.concatenate([np.square(w).sum(axis=1) for w in wander_mm]) if wander_mm else np.empty(0)
    return StreamScores(
        touches=len(touches),
        found=len(firsts),
        missed=len(touches) - len(firsts),
        ghosts=ghosts,
        split=len(pairs) - len(firsts),
        clean=all(contact.downs == 1 and contact.ups == 1 for contact in contacts),
        error_mm=np.concatenate([error_mm for error_mm, _ in together]) if together else np.empty((0, 2)),
        moving=np.concatenate([moving for _, moving in together]) if together else np.empty(0, bool),
        jitter_mm=float(np.sqrt(square_mm.mean())) if len(square_mm) else None,
        down_latency_ms=float(np.median(latency_ms)) if latency_ms else None,
    )


def _apart_mm(contact: FoundContact, touch: TrueTouch) -> float | None:
    """Return the median distance while both are down, or None if they are not the same touch."""
    if not contact.frames or not touch.frames[0] <= contact.frames[0] <= touch.frames[-1] + SLACK_FRAMES:
        return None
    error_mm, _ = _together(contact, touch)
    if not len(error_mm):
        return None
    distance_mm = float(np.median(np.linalg.norm(error_mm, axis=1)))
    return distance_mm if distance_mm <= NEAR_MM else None


def _together(contact: FoundContact, touch: TrueTouch) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return position less truth in the frames in which both are down, (n, 2), and whether the finger moved, (n,)."""
    _, mine, its = np.intersect1d(contact.frames, touch.frames, assume_unique=True, return_indices=True)
    place_mm = np.asarray(contact.position_mm, float).reshape(-1, 2)[mine]
    return place_mm - touch.position_mm[its], touch.moving[its]


def _wander_mm(contact: FoundContact, touch: TrueTouch) -> NDArray[np.float64]:
    """Return a still finger's errors less their mean, shape (n, 2): what is seen of it is jitter."""
    error_mm, moving = _together(contact, touch)
    still_mm = error_mm[~moving]
    return still_mm - still_mm.mean(axis=0) if len(still_mm) else still_mm


def _moving(position_mm: NDArray[np.float32], timestamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return in which frames a finger is faster than `STILL_MM_S`, shape (n,)."""
    moving = np.zeros(len(position_mm), bool)
    if len(position_mm) > 1:
        speed_mm_s = np.linalg.norm(np.diff(position_mm, axis=0), axis=1) / (np.diff(timestamp_ns) * 1e-9)
        fast = np.nan_to_num(speed_mm_s) > STILL_MM_S
        moving[1:] |= fast
        moving[:-1] |= fast
    return moving
