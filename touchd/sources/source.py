"""The protocol of a source of frames, and the state and tally of one with a device behind it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from touchd.event import State
from touchd.frame import Acquisition, Frame
from touchd.recording.data import Device, Meta


class EndOfStream(Exception):
    """The source has no further frame."""


class Change(NamedTuple):
    """A device's new state."""

    state: State
    reason: str
    """Why, for a person."""


@dataclass(slots=True)
class Tally:
    """Frames of a device that the source did not pass on, by reason; no count falls.

    Each frame counts once: it is read, or in one of `lost`, `corrupt`, `behind` and `withheld`.
    """

    lost: int = 0
    """Skipped by the device's counter, less the corrupt ones."""
    corrupt: int = 0
    """Failed a check."""
    behind: int = 0
    """Dropped because the pipeline was behind: the oldest of those that wait, or what the device could not keep."""
    withheld: dict[str, int] = field(default_factory=dict)
    """Valid, but no measurement of the plate: `test_pattern`, or `emitter_fault` for a chirp that was not sent."""
    clipped: int = 0
    """Passed on although the ADC clipped."""
    late: int = 0
    """Passed on although they came more than a frame period later than the quickest frames."""
    clock_ppm: float = 0.0
    """How much faster than this computer's the device's clock runs, parts per million; 0 before it is known."""


class Source(Protocol):
    """What the service needs of a source. A class that derives from it says no more than it knows and can do."""

    acquisition: Acquisition
    meta: Meta | None = None
    """Description of the recording or scene that it plays."""
    rate_hz: float | None = None
    """Frames a second, if it knows without `meta`."""
    device: Device = Device()
    """The DAQ that was opened last."""
    labelled: bool = False
    """Whether it may know where the fingers really are, as a scene does and a recording with labels: see `truth`."""
    tally: Tally | None = None
    """What was not passed on, of a source with a device behind it, which can be lost and found again."""

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame; None if none comes in time; raises EndOfStream once there is no further one."""

    def close(self) -> None:
        """Release what the source holds; further calls do nothing."""

    def changes(self) -> list[Change]:
        """Take the changes of the device's state since the last frame, in order.

        While a change waits, `read` returns None at once: no frame overtakes it.
        """
        return []

    def set_rate(self, rate_hz: int) -> bool:  # noqa: ARG002 - for those that can
        """Ask for this frame rate from the next frame on; a source that has one rate alone keeps it.

        Times tell the rate; numbers go on without a gap. Return whether nothing is left to ask for; False if the device
        did not answer.
        """
        return True

    def truth(self) -> list[tuple[float, float]]:
        """Return the places of the fingers in the frame that was read last, mm, if the source knows them."""
        return []


def touching(contacts_mm: NDArray[np.float32] | None, frame: int) -> list[tuple[float, float]]:
    """Return the places of the fingers that touch in one frame of labels of shape (n, k, 2)."""
    return [] if contacts_mm is None else [(x, y) for x, y in contacts_mm[frame].tolist() if x == x]
