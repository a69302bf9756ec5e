"""A DAQ made of software: the device's side of the USB protocol.

`touchd.gadget.functionfs` puts it on a real cable. It needs only the standard library.
"""

from __future__ import annotations

import errno
import struct
import time
from collections.abc import Callable, Iterator

from touchd.errors import GadgetError
from touchd.sources.usb_protocol import (
    Capability,
    Flag,
    Header,
    Info,
    Request,
    Status,
    build_frame,
    build_info,
    build_status,
)

BACKLOG = 8
"""Frames that the device keeps for a late host; then it drops the oldest."""
COMMANDS = ("corrupt", "short", "halt", "silent", "normal")
"""Commands of `Gadget.command`; each but the last makes a fault."""
_VENDOR_IN, _VENDOR_OUT = 0xC0, 0x40  # recipient device
_PAUSE_NS = 1_000_000_000


class Gadget:
    """Answer vendor requests, and build the frames that are due.

    GET_INFO answers `info`. `samples` are the interleaved samples of one frame after the other, at the rate that START
    asks for: at a lower one some are left out, so that a scene keeps its speed. The stream ends with them. `clock` is
    monotonic, ns. Raises GadgetError if a number of `info` has no room in GET_INFO.
    """

    def __init__(self, info: Info, samples: Iterator[bytes], clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.info = info
        try:
            self._answer = build_info(info)
        except struct.error as error:
            raise GadgetError(
                f"the frames do not fit the protocol ({error})", str(info), "serve a recording with fewer channels and "
                "lower rates",
            ) from error  # fmt: skip
        self.running = False
        self.rate_hz = 0
        self.frames_sent = 0
        self.overruns = 0
        self._samples = samples
        self._start_hz = 0
        self._due = 0.0  # samples that the scene is ahead of the last frame's
        self._clock = clock
        self._born_ns = clock()
        self._sequence = 0
        self._chirp_ns = 0  # of the next frame
        self._dropped = False
        self._fault = ""

    def control(self, kind: int, request: int, value: int, length: int) -> bytes | None:
        """Return the answer to a request, empty for one without data; None stalls it.

        The parameters are bmRequestType, bRequest, wValue and wLength.
        """
        if kind == _VENDOR_IN and request == Request.GET_INFO:
            return self._answer[:length]
        if kind == _VENDOR_IN and request == Request.GET_STATUS:
            status = Status(self.frames_sent, self.overruns, running=self.running)
            return build_status(status)[:length]
        if kind == _VENDOR_OUT and request == Request.START:
            if not self.info.min_frame_rate_hz <= value <= self.info.max_frame_rate_hz:
                return None
            self.rate_hz = self._start_hz = value
            self._chirp_ns = self._clock()
            self.running = True
            return b""
        if kind == _VENDOR_OUT and request == Request.SET_RATE and self.info.capabilities & Capability.SET_RATE:
            if not (self.running and self.info.min_frame_rate_hz <= value <= self.info.max_frame_rate_hz):
                return None
            now_ns = self._clock()
            if self._chirp_ns > now_ns:  # the frame in hand is finished
                last_ns = self._chirp_ns - 1_000_000_000 // self.rate_hz
                self._chirp_ns = max(now_ns, last_ns + 1_000_000_000 // value)
            self.rate_hz = value
            return b""
        if kind == _VENDOR_OUT and request == Request.STOP:
            self.running = False
            return b""
        return None

    def command(self, name: str) -> None:
        """Make a fault, one of COMMANDS, to test a host: in the next frame, or silence until `normal`."""
        if name not in COMMANDS:
            raise ValueError(f"no such command: {name!r}")
        self._fault = "" if name == "normal" else name

    def wait_s(self) -> float:
        """Return the time until a frame is due, s; infinite while stopped or silent."""
        if not self.running or self._fault == "silent":
            return float("inf")
        return max(0.0, (self._complete_ns() - self._clock()) * 1e-9)

    def next_transfer(self) -> bytes | int | None:
        """Return what to send now: a frame, EPIPE to halt the endpoint, or None if nothing is due."""
        if self.wait_s() > 0:
            return None
        fault, self._fault = self._fault, ""
        if fault == "halt":
            return errno.EPIPE
        self._catch_up()
        samples = self._take()
        if samples is None:
            self.running = False
            return None
        flags = Flag.DROPPED_BEFORE if self._dropped else Flag(0)
        header = Header(self._sequence, (self._chirp_ns - self._born_ns) // 1000, flags)
        frame = build_frame(self.info, header, samples)
        self._dropped = False
        self._advance()
        self.frames_sent += 1
        if fault == "corrupt":
            at = len(frame) // 2
            return frame[:at] + bytes([frame[at] ^ 1]) + frame[at + 1 :]
        return frame[: len(frame) // 2 + 1] if fault == "short" else frame

    def _catch_up(self) -> None:
        """Drop the frames beyond the backlog, as a device with little memory does."""
        period_ns = 1_000_000_000 // self.rate_hz
        late_ns = self._clock() - self._complete_ns()
        if late_ns > max(_PAUSE_NS, (BACKLOG + 1) * period_ns):
            self._chirp_ns += late_ns  # the host was away: the scene has waited
        for _ in range(late_ns // period_ns - BACKLOG if late_ns <= _PAUSE_NS else 0):
            self._take()
            self._advance()
            self.overruns += 1
            self._dropped = True

    def _take(self) -> bytes | None:
        """Return the samples of the scene's moment, None after its end."""
        self._due += max(1.0, self._start_hz / self.rate_hz)
        taken: bytes | None = None
        while self._due >= 1:
            self._due -= 1
            taken = next(self._samples, None)
        return taken

    def _advance(self) -> None:
        self._sequence = (self._sequence + 1) % (1 << 32)
        self._chirp_ns += 1_000_000_000 // self.rate_hz

    def _complete_ns(self) -> int:
        return self._chirp_ns + 1_000_000_000 * self.info.samples // self.info.sample_rate_hz
