"""Where frames come from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

from touchd.event import State
from touchd.frame import Acquisition, Frame


class EndOfStream(Exception):
    """There will be no further frame."""


class Source(Protocol):
    """What the service asks of a source."""

    acquisition: Acquisition

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None if there was none in time.

        Raises
        ------
        EndOfStream
            When there will be no further frame.
        """
        ...

    def close(self) -> None:
        """Release what the source holds; further calls do nothing."""
        ...


class Change(NamedTuple):
    """A device's new state."""

    state: State
    reason: str
    """Why, for a person."""


@dataclass(slots=True)
class Tally:
    """What became of a device's frames before anybody could read them; each frame counts once, and no number falls.

    The device's frames are those that were read, plus `lost`, `corrupt`, `behind` and `withheld`.
    """

    lost: int = 0
    """Jumped over by the device's counter, less the corrupt ones."""
    corrupt: int = 0
    """Failed a check."""
    behind: int = 0
    """Dropped, the oldest first, because the pipeline was behind."""
    withheld: dict[str, int] = field(default_factory=dict)
    """Valid, but of no plate: test patterns, chirps that the emitter failed to send; by reason."""
    clipped: int = 0
    """Taken although the ADC clipped."""
    late: int = 0
    """Taken although they came more than a frame's period later than the quickest ones."""


@runtime_checkable
class LiveSource(Source, Protocol):
    """A source with a device behind it, which can be lost and found again."""

    tally: Tally

    def changes(self) -> list[Change]:
        """Take the changes of state since the frame that was read last, in order.

        `read` returns None at once when there is one, and no later frame before they are taken.
        """
        ...
