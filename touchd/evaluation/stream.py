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


@dataclass(frozen=True, slots=True)
class TrueTouch:
    """One touch of the truth: a run of frames of one finger."""

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


def true_touches(recording: Recording) -> list[TrueTouch]:
    """Return the touches of a recording's truth, in order of their first frames."""
    if recording.contacts_mm is None:
        return []
    touches: list[TrueTouch] = []
    for finger in range(recording.contacts_mm.shape[1]):
        position_mm = recording.contacts_mm[:, finger]
        down = np.isfinite(position_mm[:, 0])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], down, [False]])))
        for first, after in edges.reshape(-1, 2):
            touches.append(TrueTouch(recording.sequence[first:after], position_mm[first:after]))
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
    owners: list[list[int]] = [[] for _ in touches]
    ghosts = 0
    errors_mm: list[NDArray[np.float64]] = []
    for number, contact in enumerate(contacts):
        matches = [
            (i, distance) for i, touch in enumerate(touches) if (distance := _apart_mm(contact, touch)) is not None
        ]
        if not matches:
            ghosts += 1
            continue
        owner = min(matches, key=lambda match: match[1])[0]
        owners[owner].append(number)
        errors_mm.append(_errors_mm(contact, touches[owner]))
    found = sum(bool(owned) for owned in owners)
    return StreamScores(
        touches=len(touches),
        found=found,
        missed=len(touches) - found,
        ghosts=ghosts,
        split=sum(len(owned) - 1 for owned in owners if owned),
        clean=all(contact.downs == 1 and contact.ups == 1 for contact in contacts),
        error_mm=np.concatenate(errors_mm) if errors_mm else np.empty((0, 2)),
    )


def _apart_mm(contact: FoundContact, touch: TrueTouch) -> float | None:
    """Return the median distance while both are down, or None if they are not the same touch."""
    if not contact.frames or not touch.frames[0] <= contact.frames[0] <= touch.frames[-1] + SLACK_FRAMES:
        return None
    errors_mm = _errors_mm(contact, touch)
    if not len(errors_mm):
        return None
    distance_mm = float(np.median(np.linalg.norm(errors_mm, axis=1)))
    return distance_mm if distance_mm <= NEAR_MM else None


def _errors_mm(contact: FoundContact, touch: TrueTouch) -> NDArray[np.float64]:
    """Return position less truth in the frames in which both are down, shape (n, 2)."""
    _, mine, its = np.intersect1d(contact.frames, touch.frames, assume_unique=True, return_indices=True)
    return np.asarray(contact.position_mm, float).reshape(-1, 2)[mine] - touch.position_mm[its]
