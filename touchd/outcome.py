"""What becomes of each frame: one outcome a frame, counted in one place."""

from __future__ import annotations

from enum import IntEnum


class Outcome(IntEnum):
    """How far a frame came. Integers, since one is counted for each frame and an index is the quickest key."""

    REPEATED = 0
    """Its number is not new: dropped."""
    STUCK = 1
    """Equal to an earlier frame, bit for bit: the DAQ hangs."""
    LEARNING = 2
    """The detector learns the untouched plate from it."""
    SCREEN_OFF = 3
    """The screen is off: the frame keeps the baseline, and no touch is looked for."""
    UNTOUCHED = 4
    """The gate is closed: noise alone explains the frame."""
    TOUCHED = 5
    """The gate is open. The localizer says which of the following it is."""
    FAINT = 6
    """Too little above the noise to say where the finger is."""
    STILL = 7
    """But for the noise, the frame that was fitted last: its touches still hold."""
    TRACKED = 8
    """Each finger was followed from where it was going, without the network."""
    INFERRED = 9
    """The network ran."""
    UNCALIBRATED = 10
    """The daemon has no model yet: the frame keeps the baseline, and nothing is placed."""


SKIPPED = {
    Outcome.LEARNING: "learning", Outcome.UNTOUCHED: "gate", Outcome.FAINT: "faint", Outcome.STILL: "still",
    Outcome.TRACKED: "tracking", Outcome.SCREEN_OFF: "screen-off", Outcome.STUCK: "frozen",
    Outcome.UNCALIBRATED: "uncalibrated",
}  # fmt: skip
"""The reasons for which frames needed no network, by their names in health messages."""
_RARE = ("frozen", "uncalibrated")
"""Named only where there are any."""


class Counters:
    """Counts the frames of a run by outcome; no number falls."""

    __slots__ = ("by_outcome", "lost")

    def __init__(self) -> None:
        self.by_outcome = [0] * len(Outcome)
        """Frames by outcome: index it with one."""
        self.lost = 0
        """Frames that the device numbered and that never came."""

    @property
    def frames(self) -> int:
        """Frames taken in: all but the repeated ones."""
        return sum(self.by_outcome) - self.repeated

    @property
    def repeated(self) -> int:
        """Frames dropped because their number was not new."""
        return self.by_outcome[Outcome.REPEATED]

    @property
    def inferred(self) -> int:
        """Frames that the network saw."""
        return self.by_outcome[Outcome.INFERRED]

    @property
    def skipped(self) -> dict[str, int]:
        """Frames that needed no network, by reason; all but those of `tracking` needed no features either."""
        counts = {name: self.by_outcome[outcome] for outcome, name in SKIPPED.items()}
        return {name: count for name, count in counts.items() if count or name not in _RARE}
