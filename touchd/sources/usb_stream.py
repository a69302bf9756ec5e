"""A DAQ on USB, from its transfers to its frames: framing, halts and overflows end here.

`touchd.sources.usb` has the device; this module knows no pyusb. docs/usb-protocol.md is the protocol.
"""

from __future__ import annotations

import contextlib
import time
from array import array
from collections.abc import Iterator
from functools import cached_property
from typing import Protocol

import numpy as np
import structlog
from pydantic import ValidationError

from touchd.frame import Acquisition, Chirp
from touchd.recording.data import Device
from touchd.sources.daq import DaqFrame, DaqGone
from touchd.sources.usb_protocol import (
    SEQUENCE_SPAN,
    Capability,
    Flag,
    FrameReader,
    Header,
    Info,
    ProtocolFault,
    Request,
)

HALT_PAUSE_S = 0.01
"""Pause after a halt is cleared, so that an endpoint that stays halted does not keep a processor busy."""
_DRAIN_TIMEOUT_MS = 10
_DRAIN_READS = 32

log = structlog.get_logger()


class RequestRefused(Exception):
    """The device stalled a request; the text says which: "refuses START"."""


class EndpointHalted(Exception):
    """The device has halted the endpoint."""


class TransferOverflow(Exception):
    """The device sent more than the buffer holds; the transfer is lost."""


class Connection(Protocol):
    """An open device of protocol 1 with its bulk IN endpoint. Every method but `close` may raise DaqGone."""

    info: Info
    serial: str
    packet_bytes: int
    """Packet size of the endpoint: a transfer of another multiple has ended."""

    def command(self, request: Request, value: int = 0) -> None:
        """Send a request without data; raises RequestRefused if the device stalls it."""

    def fill(self, buffer: array[int], timeout_ms: int) -> int | None:
        """Read one transfer into the buffer and return its length in bytes; None if nothing came in time.

        Raises EndpointHalted or TransferOverflow.
        """

    def clear_halt(self) -> None:
        """Clear a halt of the endpoint."""

    def reset(self) -> None:
        """Reset the device, which breaks the connection."""

    def close(self) -> None:
        """Release the device; never fails."""


class UsbDaq:
    """The `Daq` over a USB connection: it commands the stream, and finds the frames in its transfers."""

    def __init__(self, connection: Connection) -> None:
        info = connection.info
        self.acquisition = acquisition_of(info)
        self.device = Device(serial=connection.serial, firmware=".".join(map(str, info.firmware)))
        self.min_rate_hz, self.max_rate_hz = info.min_frame_rate_hz, info.max_frame_rate_hz
        self._connection = connection
        self._shape = info.samples, info.channels
        self._reader = FrameReader(info)
        self._found: Iterator[tuple[Header, memoryview]] | None = None  # frames of the last transfer, not read yet
        self._sequence: int | None = None  # of the last frame, unwrapped
        self._started = False
        self._halts = 0

    @cached_property
    def _buffer(self) -> array[int]:
        """Made when it is read into: a device may claim frames of 33 MB, and be skipped for it."""
        # Whole packets, so that no device can overflow it, and room for a frame that fills its last packet: the empty
        # packet behind it then belongs to the same transfer.
        packets = self._connection.info.frame_bytes // self._connection.packet_bytes + 1
        return array("B", bytes(packets * self._connection.packet_bytes))

    @cached_property
    def _view(self) -> memoryview:
        return memoryview(self._buffer).toreadonly()

    @property
    def corrupt(self) -> int:
        """Frames that failed a check, and transfers that overflowed, up to the frame that `read` returned last."""
        return self._reader.corrupt

    def start(self, rate_hz: int) -> None:
        """Begin the stream, or clear its halt and restart it, and discard what an earlier stream left behind."""
        if self._started:
            self._connection.clear_halt()
        self.stop()
        self._discard()
        try:
            self._connection.command(Request.START, rate_hz)
        except RequestRefused as error:
            raise DaqGone(f"it {error}") from error
        self._started = True

    def set_rate(self, rate_hz: int) -> None:
        """Go on at another rate, within the device's limits; a device without SET_RATE keeps its own."""
        if self._connection.info.capabilities & Capability.SET_RATE:
            rate_hz = min(max(rate_hz, self.min_rate_hz), self.max_rate_hz)
            with contextlib.suppress(RequestRefused):  # a device may refuse while it does not stream
                self._connection.command(Request.SET_RATE, rate_hz)

    def stop(self) -> None:
        """End the stream."""
        with contextlib.suppress(RequestRefused):  # a device may refuse while it does not stream
            self._connection.command(Request.STOP)

    def read(self, timeout_s: float) -> DaqFrame | None:
        """Return the next frame; None if the next transfer completes none, or does not come in time."""
        found = self._found and next(self._found, None)
        if found is None:
            size = self._read_transfer(round(timeout_s * 1000))
            if size is None:
                return None
            data = self._view[:size]
            found = self._reader.whole(data)  # as nearly every transfer is
            if found is None:
                ended = size == 0 or size % self._connection.packet_bytes != 0
                self._found = self._reader.feed(data, ended=ended)
                found = next(self._found, None)
        return None if found is None else self._decode(*found)

    def reset(self) -> None:
        """Reset the device, which breaks the connection."""
        self._connection.reset()

    def close(self) -> None:
        """Release the device; never fails."""
        self._connection.close()

    def _discard(self) -> None:
        """Read until nothing comes; the next frame may have any number."""
        self._found = None
        self._sequence = None
        self._reader.reset()
        with contextlib.suppress(EndpointHalted, TransferOverflow):
            for _ in range(_DRAIN_READS):
                if self._connection.fill(self._buffer, _DRAIN_TIMEOUT_MS) is None:
                    break

    def _read_transfer(self, timeout_ms: int) -> int | None:
        """Read one transfer and return its length in bytes; None if none came whole."""
        self._found = None
        try:
            return self._connection.fill(self._buffer, timeout_ms)
        except EndpointHalted:
            self._reader.reset()
            self._clear_halt()
        except TransferOverflow:
            self._reader.reset()
            self._reader.corrupt += 1
        return None

    def _clear_halt(self) -> None:
        self._connection.clear_halt()
        self._halts += 1
        if self._halts & (self._halts - 1) == 0:  # the 1st, 2nd, 4th, 8th
            log.warning("endpoint halted, cleared", halts=self._halts)
        time.sleep(HALT_PAUSE_S)

    def _decode(self, header: Header, samples: memoryview) -> DaqFrame:
        """Return a frame whose counts are a view of the transfer."""
        counts = np.frombuffer(samples, "<i2").reshape(self._shape).T
        flags, sequence = header.flags, self._unwrap(header.sequence)
        if not flags:
            return DaqFrame(counts, sequence, header.timestamp_us)
        withheld = ""
        if flags & (Flag.TEST_PATTERN | Flag.EMITTER_FAULT):
            withheld = "test_pattern" if flags & Flag.TEST_PATTERN else "emitter_fault"
        return DaqFrame(counts, sequence, header.timestamp_us, bool(flags & Flag.CLIPPED), withheld)

    def _unwrap(self, sequence: int) -> int:
        """Continue the device's counter over its wrap; a small step back stays one."""
        if self._sequence is not None:
            half = SEQUENCE_SPAN // 2
            sequence = self._sequence + (sequence - self._sequence + half) % SEQUENCE_SPAN - half
        self._sequence = sequence
        return sequence


def acquisition_of(info: Info) -> Acquisition:
    """Return the geometry of a device's frames, in touchd's units; raises ProtocolFault if no rig has it."""
    try:
        chirp = Chirp(
            start_hz=info.chirp_start_hz, stop_hz=info.chirp_stop_hz, duration_s=info.chirp_us / 1e6,
            dac_rate_hz=info.dac_rate_hz,
        )  # fmt: skip
        return Acquisition(
            channels=info.channels, samples=info.samples, sample_rate_hz=info.sample_rate_hz, bits=info.bits,
            full_scale_v=info.full_scale_mv / 1e3, chirp=chirp,
        )  # fmt: skip
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        raise ProtocolFault(f"GET_INFO means {name} = {first['input']}: {first['msg']}") from error
