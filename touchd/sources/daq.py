"""What `DaqSource` needs from a DAQ, over any connection, and how it chooses among those that are there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import structlog
from msgspec import Struct

from touchd.config.schema import DeviceSettings
from touchd.errors import ConfigError, DeviceBusy, DeviceLost, TouchdError
from touchd.frame import Acquisition, Counts
from touchd.recording.data import Device

log = structlog.get_logger()


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
    """An open connection to one device. Every method but `close` may raise DaqGone.

    A class that derives from it has one rate, no corrupt frames, and nothing to stop or reset, unless it says else.
    """

    acquisition: Acquisition
    """What its frames look like."""
    device: Device
    """What a recording says of it: serial number and firmware."""
    min_rate_hz: int = 1
    max_rate_hz: int
    """Frame rates that `start` takes, Hz."""

    @property
    def corrupt(self) -> int:
        """Frames that failed a check on this connection, up to the one that `read` returned last; never falls."""
        return 0

    def start(self, rate_hz: int) -> None:
        """Begin the stream, or restart it, and discard what an earlier stream left behind."""

    def set_rate(self, rate_hz: int) -> None:  # noqa: ARG002 - for those that can
        """Go on at another rate, as far as the device can; from any thread, while another one reads."""
        return

    def stop(self) -> None:
        """End the stream."""
        return

    def read(self, timeout_s: float) -> DaqFrame | None:
        """Return the next valid frame; None if none came in time, or the device sent something else first."""

    def reset(self) -> None:
        """Reset the device, which breaks the connection."""
        return

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


class DeviceSearch:
    """Opens the first device that fits. After a connection that brought no frame it begins with the next one.

    `check` raises a TouchdError if a device with this acquisition must not be used.
    """

    def __init__(self, candidates: Candidates, settings: DeviceSettings, check: Callable[[Acquisition], None]) -> None:
        self.skipped = ""
        """Which devices the last search skipped, and why."""
        self._candidates, self._settings, self._check = candidates, settings, check
        self._first = 0

    def find(self) -> Daq:
        """Return an open device that fits; raises DaqAbsent with what is wrong with each."""
        openers = list(self._candidates())
        first = self._first % max(len(openers), 1)
        unfit, absent = [], []
        for opener in openers[first:] + openers[:first]:
            try:
                daq = opener()
                self._accept(daq)
            except DaqUnfit as why:
                unfit.append(str(why))
            except (DaqAbsent, DaqGone) as why:
                absent.append(str(why))
            else:
                self._note("; ".join(unfit))
                self._first += 1
                return daq
        self._note("; ".join(unfit))
        raise DaqAbsent("; ".join(unfit + absent))

    def keep(self) -> None:
        """Begin the next search where the last one began: its device has sent a frame."""
        self._first -= 1

    def _accept(self, daq: Daq) -> None:
        """Close and refuse a device that the model does not fit, or that does not have the frame rate."""
        try:
            self._check(daq.acquisition)
            check_rate(daq, self._settings)
        except BaseException as error:
            daq.close()
            if isinstance(error, TouchdError):
                raise DaqUnfit(f"device {daq.device.serial!r} is skipped: {error}") from error
            raise

    def _note(self, why: str) -> None:
        if why and why != self.skipped:
            log.warning("device skipped", why=why)
        self.skipped = why


def open_first(candidates: Candidates) -> Daq:
    """Return the first device that can be opened; raises DeviceLost or DeviceBusy."""
    absent: list[DaqAbsent | DaqGone] = []
    try:
        for opener in candidates():
            try:
                return opener()
            except (DaqAbsent, DaqGone) as why:
                absent.append(why)
    except DaqAbsent as why:  # devices cannot be listed
        absent.append(why)
    what = "; ".join(map(str, absent))
    if any(isinstance(why, DaqBusy) for why in absent):
        fix = "stop the daemon, or set control.socket, for it and this command alike: it then hands out its frames"
        raise DeviceBusy(what, "device", fix)
    raise DeviceLost(what, "device", "plug it in, or add --replay FILE or --simulate SCENE")


def check_rate(daq: Daq, settings: DeviceSettings) -> None:
    """Raise ConfigError unless a device has the frame rate that is set."""
    if not daq.min_rate_hz <= settings.rate_hz <= daq.max_rate_hz:
        raise ConfigError(
            f"is {settings.rate_hz}, but the DAQ takes {daq.min_rate_hz} to {daq.max_rate_hz} frames a second",
            "device.rate_hz", "set it within this range",
        )  # fmt: skip
