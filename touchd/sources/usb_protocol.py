"""The USB protocol, version 1, as bytes: build and parse GET_INFO and frames, build GET_STATUS.

It touches no device and needs only the standard library, so that a device written in Python can use it too.
docs/usb-protocol.md is the specification.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple

PROTOCOL: Final = 1
INTERFACE_CLASS: Final = (0xFF, 0x54, 0x01)
"""Class, subclass and protocol of the interface descriptor."""
INFO_BYTES: Final = 64
HEADER_BYTES: Final = 32
UNKNOWN_TEMPERATURE: Final = -32768
SEQUENCE_SPAN: Final = 1 << 32
"""The counter of chirps wraps here."""

_INFO_MAGIC: Final = b"TDAQ"
_FRAME_MAGIC: Final = b"TDFR"
_FRAME_VERSION: Final = 1
_INFO = struct.Struct("<4sHHBBHIIIIIIHHII16x")
_STATUS = struct.Struct("<QIIhB13x")
_HEADER = struct.Struct("<4sBBHIBBHQhHI")
_CRC_OFFSET = 28
_NO_CRC = bytes(4)
assert (_INFO.size, _HEADER.size) == (INFO_BYTES, HEADER_BYTES)


class Request(IntEnum):
    """Vendor requests, recipient device."""

    GET_INFO = 0x01
    START = 0x02
    STOP = 0x03
    GET_STATUS = 0x04
    SET_RATE = 0x05


class Capability(IntFlag):
    """Bits of `capabilities`: what a device can beyond the rest of the protocol."""

    SET_RATE = 1


class Flag(IntFlag):
    """Bits of a frame's `flags`."""

    CLIPPED = 1
    EMITTER_FAULT = 2
    DROPPED_BEFORE = 4
    TEST_PATTERN = 8


class ProtocolFault(ValueError):
    """Bytes that break the protocol; the text says how."""


@dataclass(frozen=True, slots=True)
class Info:
    """The answer to GET_INFO: the device, and the geometry of its frames."""

    channels: int
    samples: int
    sample_rate_hz: int
    bits: int = 16
    dac_rate_hz: int = 500_000
    chirp_start_hz: int = 50_000
    chirp_stop_hz: int = 100_000
    chirp_us: int = 1000
    full_scale_mv: int = 10_000
    max_frame_rate_hz: int = 1000
    min_frame_rate_hz: int = 1
    firmware: tuple[int, int, int] = (0, 0, 0)
    """Major, minor, patch."""
    capabilities: int = 0
    """Bits of `Capability`; 0 of a device older than the field."""

    @property
    def frame_bytes(self) -> int:
        """Length of a frame with its header."""
        return HEADER_BYTES + 2 * self.channels * self.samples


@dataclass(frozen=True, slots=True)
class Status:
    """The answer to GET_STATUS."""

    frames_sent: int = 0
    overruns: int = 0
    """Frames that the device dropped because the host was late."""
    trigger_faults: int = 0
    temperature: int = UNKNOWN_TEMPERATURE
    """0.01 degrees Celsius; -32768 is unknown."""
    running: bool = False


class Header(NamedTuple):
    """The fields of a frame's header that differ from frame to frame."""

    sequence: int
    """Counts chirps, modulo 2**32."""
    timestamp_us: int
    """The device's clock at the start of the chirp."""
    flags: int = 0
    temperature: int = UNKNOWN_TEMPERATURE
    """0.01 degrees Celsius; -32768 is unknown."""


def build_info(info: Info) -> bytes:
    """Return the 64 bytes of GET_INFO."""
    major, minor, patch = info.firmware
    return _INFO.pack(
        _INFO_MAGIC, PROTOCOL, HEADER_BYTES, info.channels, info.bits, info.samples, info.sample_rate_hz,
        info.dac_rate_hz, info.chirp_start_hz, info.chirp_stop_hz, info.chirp_us, info.full_scale_mv,
        info.max_frame_rate_hz, info.min_frame_rate_hz, major << 16 | minor << 8 | patch,
        info.capabilities,
    )  # fmt: skip


def parse_info(data: bytes) -> Info:
    """Read the answer to GET_INFO.

    Raises ProtocolFault if the bytes are none, of another protocol version, or describe an impossible frame.
    """
    if len(data) < INFO_BYTES or data[:4] != _INFO_MAGIC:
        raise ProtocolFault(f"GET_INFO answers {len(data)} bytes that begin with {data[:4].hex() or 'nothing'}")
    (_, protocol, header_bytes, channels, bits, samples, sample_rate_hz, dac_rate_hz, start_hz, stop_hz, chirp_us,
     full_scale_mv, max_rate_hz, min_rate_hz, firmware, capabilities) = _INFO.unpack_from(data)  # fmt: skip
    if protocol != PROTOCOL or header_bytes != HEADER_BYTES:
        raise ProtocolFault(f"the device speaks protocol {protocol} with headers of {header_bytes} bytes")
    for name, value in {"channels": channels, "samples": samples, "sample_rate_hz": sample_rate_hz,
                        "chirp_start_hz": start_hz, "chirp_stop_hz": stop_hz, "chirp_us": chirp_us,
                        "dac_rate_hz": dac_rate_hz, "full_scale_mv": full_scale_mv}.items():  # fmt: skip
        if value == 0:
            raise ProtocolFault(f"GET_INFO says {name} = 0")
    if not 2 <= bits <= 16:
        raise ProtocolFault(f"GET_INFO says bits = {bits}, not 2 to 16")
    if not 1 <= min_rate_hz <= max_rate_hz:
        raise ProtocolFault(f"GET_INFO says frame rates from {min_rate_hz} to {max_rate_hz} Hz")
    return Info(
        channels, samples, sample_rate_hz, bits, dac_rate_hz, start_hz, stop_hz, chirp_us, full_scale_mv, max_rate_hz,
        min_rate_hz, (firmware >> 16, firmware >> 8 & 0xFF, firmware & 0xFF), capabilities,
    )  # fmt: skip


def build_status(status: Status) -> bytes:
    """Return the 32 bytes of GET_STATUS."""
    return _STATUS.pack(
        status.frames_sent, status.overruns, status.trigger_faults, status.temperature, status.running
    )  # fmt: skip


def build_frame(info: Info, header: Header, samples: bytes) -> bytes:
    """Return a frame: header with its CRC, then the samples, int16 and interleaved (s0c0 s0c1 ... s1c0 ...)."""
    if len(samples) != info.frame_bytes - HEADER_BYTES:
        raise ValueError(f"{len(samples)} bytes of samples, not {info.frame_bytes - HEADER_BYTES}")
    fields = _HEADER.pack(
        _FRAME_MAGIC, _FRAME_VERSION, header.flags, HEADER_BYTES, header.sequence % SEQUENCE_SPAN, info.channels,
        info.bits, info.samples, header.timestamp_us, header.temperature, 0, 0,
    )  # fmt: skip
    frame = bytearray(fields)
    frame += samples
    struct.pack_into("<I", frame, _CRC_OFFSET, zlib.crc32(frame))
    return bytes(frame)


class FrameReader:
    """Find the valid frames in the transfers of a bulk endpoint.

    Normally a transfer is a frame. If it is not (a read timed out within a frame, a frame is cut short, rubbish comes),
    the reader searches byte by byte for the next frame with a valid header and CRC. A frame of another geometry than
    `info` says is corrupt.
    """

    def __init__(self, info: Info) -> None:
        self.corrupt = 0
        """Frames that failed a check: between two valid frames, the length of the rubbish in frames, rounded up."""
        self._frame_bytes = info.frame_bytes
        self._sizes = (_FRAME_MAGIC, _FRAME_VERSION, HEADER_BYTES, info.channels, info.bits, info.samples)
        self._pending = bytearray()
        self._skipped = 0  # bytes since the last valid frame, or the last end of a transfer

    def whole(self, data: memoryview) -> tuple[Header, memoryview] | None:
        """Return the header and samples of data that are one valid frame and no more; else None."""
        if len(data) != self._frame_bytes or self._pending:
            return None
        header = self._header(data, 0)
        return (header, data[HEADER_BYTES:]) if header is not None and self._intact(data) else None

    def feed(self, data: memoryview, *, ended: bool) -> Iterator[tuple[Header, memoryview]]:
        """Take the data of one read, and yield the header and the samples of each valid frame.

        The samples are a view of bytes, valid while `data` does not change. At each frame `corrupt` holds the corrupt
        frames before it. `ended` says that a short packet has closed the transfer: no later byte belongs to a frame
        that has begun in it.
        """
        self._pending += data
        yield from self._search()
        if ended:
            self.reset()

    def reset(self) -> None:
        """Discard a frame that has begun: no later byte belongs to it."""
        self._skipped += len(self._pending)
        self._pending.clear()
        self._close_gap()

    def _search(self) -> Iterator[tuple[Header, memoryview]]:
        pending, size = self._pending, self._frame_bytes
        at = 0
        while True:
            found = pending.find(_FRAME_MAGIC, at)
            if found < 0:
                # The last bytes may begin a magic number.
                found = max(at, len(pending) - len(_FRAME_MAGIC) + 1)
            self._skipped += found - at
            at = found
            if len(pending) - at < HEADER_BYTES:
                break
            header = self._header(pending, at)
            if header is not None and len(pending) - at < size:
                break
            if header is not None and self._intact(candidate := memoryview(bytes(pending[at : at + size]))):
                self._close_gap()
                at += size
                yield header, candidate[HEADER_BYTES:]
            else:
                self._skipped += 1
                at += 1
        del pending[:at]

    def _header(self, data: memoryview | bytearray, at: int) -> Header | None:
        magic, version, flags, header_bytes, sequence, channels, bits, samples, timestamp_us, temperature, _, _ = (
            _HEADER.unpack_from(data, at)
        )
        if (magic, version, header_bytes, channels, bits, samples) != self._sizes:
            return None
        return Header(sequence, timestamp_us, flags, temperature)

    @staticmethod
    def _intact(frame: memoryview) -> bool:
        crc = zlib.crc32(frame[HEADER_BYTES:], zlib.crc32(_NO_CRC, zlib.crc32(frame[:_CRC_OFFSET])))
        return bool(crc == int.from_bytes(frame[_CRC_OFFSET:HEADER_BYTES], "little"))

    def _close_gap(self) -> None:
        self.corrupt += -(-self._skipped // self._frame_bytes)
        self._skipped = 0
