"""Score a replay: match published contacts with the recording's true touches."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.matching import Matches, Position, Seen, match, match_frames, seen_in
from touchd.evaluation.model_scores import Judgement
from touchd.evaluation.truth import TrueTouch, fingers_only, rough_frames, true_touches
from touchd.event import Contact, TouchEvent
from touchd.recording.data import Recording

SLACK_FRAMES = 10
"""A contact may end this many frames after its touch, because release and filter lag."""


@dataclass(slots=True)
class FoundContact:
    """A contact's messages, from first to last."""

    frames: list[int] = field(default_factory=list)
    position_mm: list[Position] = field(default_factory=list)
    downs: int = 0
    ups: int = 0
    palm: bool = False
    """Whether it went up as a palm's."""
    followed: list[int | None] = field(default_factory=list)
    """Index of the touch that each message matches, by `match`; None if none."""
    touch: int | None = None
    """Index of the touch that the contact belongs to; None for a ghost."""


@dataclass(frozen=True, slots=True)
class StreamScores:
    """Counts and errors of a replay's contacts against the true touches."""

    touches: int
    found: int
    """Touches with at least one contact."""
    ghosts: int
    """Contacts without a touch."""
    split: int
    """Contacts beyond the first of a touch."""
    switches: int
    """Times that a contact's id jumps to another finger."""
    clean: bool
    """Whether each contact has exactly one down and one up."""
    error_mm: NDArray[np.float64]
    """Estimated less true position for each contact of each message, shape (n, 2)."""
    moving: NDArray[np.bool_]
    """Whether the finger moves, for each error, shape (n,)."""
    wander_mm2: NDArray[np.float64]
    """Square distances of still fingers' positions from their mean, shape (m,)."""
    latency_ms: NDArray[np.float64]
    """From a touch's first frame to its first message, shape (found,)."""
    settled: Matches
    """Contacts and fingers of the settled frames; see `settled_frames`."""

    @property
    def missed(self) -> int:
        """Touches without a contact."""
        return self.touches - self.found

    @property
    def jitter_mm(self) -> float | None:
        """RMS distance of a still finger's positions from their mean, over all touches."""
        return float(np.sqrt(self.wander_mm2.mean())) if len(self.wander_mm2) else None

    @property
    def down_latency_ms(self) -> float | None:
        """Median time from a touch's first frame to its first message."""
        return float(np.median(self.latency_ms)) if len(self.latency_ms) else None


Part = TypeVar("Part", StreamScores, Matches, Judgement)


def joined(parts: Sequence[Part]) -> Part:
    """Return the scores of recordings that follow each other as those of one: numbers added, arrays joined."""

    def of(name: str) -> Any:
        values = [getattr(part, name) for part in parts]
        if isinstance(values[0], np.ndarray):
            return np.concatenate(values)
        if isinstance(values[0], bool):
            return all(values)
        if isinstance(values[0], int):
            return sum(values)
        return joined(values) if is_dataclass(values[0]) else values[0]

    return type(parts[0])(**{each.name: of(each.name) for each in fields(parts[0])})


def found_contacts(events: Iterable[TouchEvent]) -> list[FoundContact]:
    """Collect the contacts of touch messages, ordered by id."""
    contacts: dict[int, FoundContact] = {}
    for event in events:
        for contact in event.contacts:
            found = contacts.setdefault(contact.id, FoundContact())
            found.downs += contact.phase == "down"
            found.ups += contact.phase == "up"
            found.palm |= contact.kind == "palm"
            if contact.phase != "up":
                found.frames.append(event.frame)
                found.position_mm.append((contact.x_mm, contact.y_mm))
    return [contacts[i] for i in sorted(contacts)]


def score_stream(recording: Recording, events: Sequence[TouchEvent]) -> StreamScores:
    """Match the contacts of a replay's touch messages with the recording's true fingers.

    Each message assigns contacts to fingers, see `match`. A contact belongs to the touch that it matches in most
    messages, among touches that began before it. It is a ghost if it matches no touch in at least half of the messages
    in which a finger is down. Of the acts of `touchd record --label` taps alone tell positions.
    """
    recording = fingers_only(recording)
    touches, contacts = true_touches(recording), found_contacts(events)
    seconds = dict(zip(recording.sequence.tolist(), (recording.timestamp_ns * 1e-9).tolist(), strict=True))
    down = _down(touches)
    _follow(contacts, down)
    for contact in contacts:
        contact.touch = _touch_of(contact, touches, down)
    owned = [[contact for contact in contacts if contact.touch == i] for i in range(len(touches))]
    errors = _errors(contacts, down, rough_frames(recording))
    parts = list(errors.values())
    error_mm = np.concatenate([error for error, _ in parts]) if parts else np.empty((0, 2))
    latency_ms = [
        1e3 * (seconds[mine[0].frames[0]] - touch.start_s)
        for mine, touch in zip(owned, touches, strict=True) if mine
    ]  # fmt: skip
    still = [error[~moving] for error, moving in parts if not moving.all()]
    # The scatter of a still finger about its own mean is jitter.
    wander = [np.square(error - error.mean(axis=0)).sum(axis=1) for error in still]
    found = sum(map(bool, owned))
    matched = [[index for index in contact.followed if index is not None] for contact in contacts]
    return StreamScores(
        touches=len(touches),
        found=found,
        ghosts=sum(contact.touch is None for contact in contacts),
        split=sum(map(len, owned)) - found,
        switches=sum(before != after for indices in matched for before, after in pairwise(indices)),
        clean=all(contact.downs == 1 and contact.ups == 1 for contact in contacts),
        error_mm=error_mm,
        moving=np.concatenate([moving for _, moving in parts]) if parts else np.empty(0, bool),
        wander_mm2=np.concatenate([*wander, np.empty(0)]),
        latency_ms=np.array(latency_ms, float),
        settled=match_frames(settled_frames(recording, events)),
    )


def settled_frames(recording: Recording, events: Iterable[TouchEvent]) -> Iterator[Seen]:
    """Yield a subscriber's contacts for each settled frame: those of the last message that are not up.

    A frame is settled `SLACK_FRAMES` after the last finger landed or lifted; confirmation takes that time.
    """
    truth = recording.contacts_mm
    if truth is None:
        return
    messages = {event.frame: event.contacts for event in events}
    alive: tuple[Contact, ...] = ()
    down = np.asarray(np.isfinite(truth[:, :, 0]))
    numbers = recording.sequence
    changes = np.flatnonzero((down[1:] != down[:-1]).any(axis=1)) + 1
    changed_at = np.concatenate([numbers[:1] - SLACK_FRAMES, numbers[changes]])
    settled = numbers >= changed_at[np.searchsorted(changes, np.arange(len(numbers)), "right")] + SLACK_FRAMES
    touched: list[bool] = np.asarray(down.any(axis=1)).tolist()
    rough, untouched = rough_frames(recording), Seen((), ())
    for i, (number, is_settled) in enumerate(zip(numbers.tolist(), settled.tolist(), strict=True)):
        if number in messages:
            alive = tuple(contact for contact in messages[number] if contact.phase != "up")
        if not is_settled or number in rough:
            continue
        if not touched[i]:
            yield Seen((), alive) if alive else untouched
        else:
            yield seen_in(recording, i, alive)


Down = dict[int, dict[int, tuple[float, float, bool]]]
"""By frame and index of each touch that is down: its x and y, mm, and whether it moves."""
Errors = dict[tuple[int, int], tuple[NDArray[np.float64], NDArray[np.bool_]]]


def _down(touches: list[TrueTouch]) -> Down:
    down: Down = {}
    for index, touch in enumerate(touches):
        rows = zip(touch.frames.tolist(), touch.position_mm.tolist(), touch.moving.tolist(), strict=True)
        for number, (x_mm, y_mm), moving in rows:
            down.setdefault(number, {})[index] = (x_mm, y_mm, moving)
    return down


def _follow(contacts: list[FoundContact], down: Down) -> None:
    """Match each contact with a touch, message by message."""
    messages: dict[int, list[tuple[FoundContact, int]]] = {}
    for contact in contacts:
        contact.followed = [None] * len(contact.frames)
        for k, number in enumerate(contact.frames):
            messages.setdefault(number, []).append((contact, k))
    for number, alive in messages.items():
        fingers = down.get(number, {})
        true_mm = [(x_mm, y_mm) for x_mm, y_mm, _ in fingers.values()]
        for i, j in match(true_mm, [contact.position_mm[k] for contact, k in alive]):
            contact, k = alive[j]
            contact.followed[k] = list(fingers)[i]


def _touch_of(contact: FoundContact, touches: list[TrueTouch], down: Down) -> int | None:
    together = sum(number in down for number in contact.frames)
    count = Counter(index for index in contact.followed if index is not None)
    if not count or 2 * count.total() < together:
        return None
    for index, _ in count.most_common():
        frames = touches[index].frames
        if frames[0] <= contact.frames[0] <= frames[-1] + SLACK_FRAMES:
            return index
    return None


def _errors(contacts: list[FoundContact], down: Down, rough: set[int]) -> Errors:
    """Return estimated less true position (n, 2) and whether the finger moves (n,), by contact and touch.

    A contact too far from every finger is compared with its own touch, unless another contact matches that touch:
    large errors count. Frames of rough labels do not.
    """
    taken = {pair for contact in contacts for pair in zip(contact.frames, contact.followed, strict=True)}
    found: dict[tuple[int, int], list[tuple[float, float, bool]]] = {}
    for name, contact in enumerate(contacts):
        if contact.touch is None:
            continue
        for number, (x_mm, y_mm), index in zip(contact.frames, contact.position_mm, contact.followed, strict=True):
            if index is None and (number, contact.touch) not in taken:
                index = contact.touch
            if index is not None and number not in rough and index in down.get(number, {}):
                true_x_mm, true_y_mm, moving = down[number][index]
                found.setdefault((name, index), []).append((x_mm - true_x_mm, y_mm - true_y_mm, moving))
    tables = {key: np.array(values) for key, values in found.items()}
    return {key: (table[:, :2], table[:, 2] > 0) for key, table in tables.items()}
