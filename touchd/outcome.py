"""What became of the frames, and of the messages that they meant."""

from __future__ import annotations

from dataclasses import dataclass, field


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
    unheard: dict[str, int] = field(default_factory=lambda: {"touch": 0, "spectrum": 0})
    """Messages that were not made because nobody was subscribed, by topic."""
