"""What a source asks of a DAQ, whatever connects it: `touchd.sources.usb` has the one on USB."""

from __future__ import annotations

from typing import Protocol

from touchd.frame import Acquisition, Chirp
from touchd.recording.data import Device
from touchd.sources.usb_protocol import Info


class DaqAbsent(Exception):
    """No device can be used at present; the text says why."""


class DaqGone(Exception):
    """The device may be gone: look for it again."""


class DaqHalted(Exception):
    """The device has halted its endpoint: clear that, and go on."""


class DaqOverflow(Exception):
    """The device sent more than was asked for; that transfer is lost."""


class Daq(Protocol):
    """A connection to one device, opened and described. Every method may raise DaqGone."""

    info: Info
    serial: str
    packet_bytes: int
    """Of the endpoint: a read of another multiple ends a transfer."""

    def start(self, rate_hz: int) -> None:
        """Begin the stream anew; what an earlier one left behind is thrown away."""

    def stop(self) -> None:
        """End the stream."""

    def read(self, timeout_s: float) -> memoryview | None:
        """Return what one transfer brought, valid until the next call; None if nothing came in time.

        Raises
        ------
        DaqHalted, DaqOverflow
        """

    def clear_halt(self) -> None:
        """Let a halted endpoint go on."""

    def reset(self) -> None:
        """Reset the device; it has to be looked for again."""

    def close(self) -> None:
        """Let go of the device; never fails."""


def acquisition_of(info: Info) -> Acquisition:
    """Return the geometry of a device's frames, in touchd's units."""
    chirp = Chirp(
        start_hz=info.chirp_start_hz, stop_hz=info.chirp_stop_hz, duration_s=info.chirp_us / 1e6,
        dac_rate_hz=info.dac_rate_hz,
    )  # fmt: skip
    return Acquisition(
        channels=info.channels, samples=info.samples, sample_rate_hz=info.sample_rate_hz, bits=info.bits,
        full_scale_v=info.full_scale_mv / 1e3, chirp=chirp,
    )  # fmt: skip


def device_of(daq: Daq) -> Device:
    """Return what a recording says of a device."""
    return Device(serial=daq.serial, firmware=".".join(map(str, daq.info.firmware)))
