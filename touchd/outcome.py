"""What became of the frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum


class Outcome(IntEnum):
    """What became of one frame."""

    REPEATED = 0
    STUCK = 1
    LEARNING = 2
    SCREEN_OFF = 3
    UNTOUCHED = 4
    TOUCHED = 5
    FAINT = 6
    STILL = 7
    TRACKED = 8
    INFERRED = 9


@dataclass(slots=True)
class Counters:
    """Numbers since the start, none of which falls."""

    frames: int = 0
    """Taken in."""
    lost: int = 0
    """Jumped over by their numbers."""
    repeated: int = 0
    """Dropped, since their number was not new."""
    inferred: int = 0
    """Gone through features and network."""
    skipped: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("learning", "gate", "faint", "still", "tracking", "screen-off"), 0)
    )
    """Frames that needed no network, by reason; all but those of `tracking` needed no features either."""
