"""What `DaqSource` needs from a DAQ, over any connection: `usb` has the one on USB, `ni` a rig of NI hardware."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from msgspec import Struct

from touchd.frame import Acquisition, Counts
from touchd.recording.data import Device


class DaqAbsent(Exception):
    """No device can be used at present; the text says why."""


class DaqBusy(DaqAbsent):
    """A device that another program uses."""


class DaqUnfit(DaqAbsent):
    """A device of the protocol that cannot be used, and why."""


class DaqGone(Exception):
    """The connection is of no more use: close it and look for the device again. The text says why."""


class DaqFrame(Struct, gc=False, frozen=True):
    """What a device measured during one chirp, numbered and dated by the device."""

    counts: Counts
    """ADC counts of shape (channels, samples), a view that is valid until the next `read`."""
    sequence: int
    """Number of the chirp, unwrapped: it grows by 1 from chirp to chirp. Any number may be the first after `start`."""
    timestamp_us: int
    """The device's clock at the start of the chirp, us."""
    clipped: bool = False
    """A sample is at the ADC's limit."""
    withheld: str = ""
    """Why the counts are no measurement of the plate, a key of `Tally.withheld`; empty if they are one."""


class Daq(Protocol):
    """An open connection to one device. Every method but `close` may raise DaqGone."""

    acquisition: Acquisition
    """What its frames look like."""
    device: Device
    """What a recording says of it: serial number and firmware."""
    min_rate_hz: int
    max_rate_hz: int
    """Frame rates that `start` takes, Hz."""

    @property
    def corrupt(self) -> int:
        """Frames that failed a check on this connection, up to the one that `read` returned last; never falls."""

    def start(self, rate_hz: int) -> None:
        """Begin the stream, or restart it, and discard what an earlier stream left behind."""

    def set_rate(self, rate_hz: int) -> None:
        """Go on at another rate, as far as the device can; from any thread, while another one reads."""

    def stop(self) -> None:
        """End the stream."""

    def read(self, timeout_s: float) -> DaqFrame | None:
        """Return the next valid frame; None if none came in time, or the device sent something else first."""

    def reset(self) -> None:
        """Reset the device, which breaks the connection."""

    def close(self) -> None:
        """Release the device; never fails."""


Candidates = Callable[[], Iterator[Callable[[], Daq]]]
"""Lists the devices that may be used at present, as calls that open one; opening raises DaqAbsent or DaqGone."""


@dataclass(frozen=True, slots=True)
class Waits:
    """How long the thread that reads the device waits, seconds."""

    read_s: float = 0.1
    """Timeout of a read: while no frame comes, the thread notices `close` this late."""
    retry_s: float = 0.1
    """Shortest interval between two looks for a device."""
    max_retry_s: float = 0.5
    """Longest interval; the intervals grow from look to look."""
    hang_s: float = 10.0
    """A thread that is silent this long hangs in the kernel, and only a new process helps."""


WAITS = Waits()
