"""TUIO 1.1 over UDP: cursors, and blobs where contacts have a size.

Source: the TUIO 1.1 protocol specification, tuio.org, and the reference client TUIO11_CPP. All of it is OSC 1.0.
"""

from __future__ import annotations

import math
import socket
import struct
from collections.abc import Callable, Mapping

from touchd.bridges.area import Area, Place
from touchd.bridges.bridge import Down, Output

CURSOR, BLOB = "/tuio/2Dcur", "/tuio/2Dblb"
_FSEQ_MAX = 0x7FFFFFFF
_START_OR_END = -1
_FORGOTTEN_NS = 60_000_000_000
"""A failure that comes again this long after the last one is said again."""
_REPEAT_NS = 250_000_000
"""A client that lost a frame has the next one, or this repeat of the last."""


_MOST = 3.4e38  # of float32


def message(address: str, *arguments: str | int | float) -> bytes:
    """Return an OSC message: int32, float32 and text."""
    tags, body = ",", b""
    for argument in arguments:
        if isinstance(argument, str):
            tags, body = tags + "s", body + _text(argument)
        elif isinstance(argument, int):
            tags, body = tags + "i", body + struct.pack(">i", argument)
        else:
            tags, body = tags + "f", body + struct.pack(">f", min(max(argument, -_MOST), _MOST))
    return _text(address) + _text(tags) + body


def bundle(*messages: bytes) -> bytes:
    """Return an OSC bundle that holds at once."""
    return b"#bundle\0" + struct.pack(">Q", 1) + b"".join(struct.pack(">i", len(each)) + each for each in messages)


def _text(text: str) -> bytes:
    data = text.encode("ascii", "replace") + b"\0"
    return data + b"\0" * (-len(data) % 4)


class Frames:
    """Makes the bundles of one source: pure, but for the speeds of the frame before.

    Frames and sessions count from the clock's milliseconds, so that a client takes none of a restarted bridge for a
    late or an old one; an empty frame numbered -1 begins and ends the stream. A bundle is never split: ten fingers
    take 1000 bytes. `source` is `NAME@ADDRESS`.
    """

    def __init__(self, source: str, size_mm: tuple[float, float], now_ns: int) -> None:
        self._source, self._size_mm = source, size_mm
        self._first = self._fseq = now_ns // 1_000_000 & _FSEQ_MAX
        self._speeds: dict[int, tuple[float, int]] = {}  # widths a second, and when, ns
        self._sized = False

    def boundary(self) -> list[bytes]:
        """Return the empty bundles that begin and end the stream."""
        return [self._bundle(profile, {}, _START_OR_END) for profile in (CURSOR, BLOB)]

    def frame(self, places: Mapping[int, Place], t_ns: int) -> list[bytes]:
        """Return a frame's bundles; that of the blobs once a contact had a size."""
        self._fseq = self._fseq % _FSEQ_MAX + 1
        cursors: dict[int, list[float]] = {}
        blobs: dict[int, list[float]] = {}
        speeds = {}
        wide_mm, high_mm = self._size_mm
        for number, place in places.items():
            session = self._first + number & _FSEQ_MAX
            at = [place.x_mm / wide_mm, place.y_mm / high_mm]
            velocity = [place.vx_mm_s / wide_mm, place.vy_mm_s / high_mm]
            speed = math.hypot(*velocity)
            before, before_ns = self._speeds.get(number, (speed, 0))
            change = (speed - before) * 1e9 / (t_ns - before_ns) if t_ns > before_ns else 0.0
            speeds[number] = speed, t_ns
            cursors[session] = [*at, *velocity, change]
            major_mm, minor_mm = place.contact.major_mm, place.contact.minor_mm
            if major_mm and minor_mm:
                angle = math.radians(place.angle_deg % 360.0)
                extent = [major_mm / wide_mm, minor_mm / high_mm]
                area = math.pi / 4 * extent[0] * extent[1]
                blobs[session] = [*at, angle, *extent, area, *velocity, 0.0, change, 0.0]
        self._speeds = speeds
        self._sized |= bool(blobs)
        bundles = [self._bundle(CURSOR, cursors, self._fseq)]
        return [*bundles, self._bundle(BLOB, blobs, self._fseq)] if self._sized else bundles

    def _bundle(self, profile: str, rows: Mapping[int, list[float]], fseq: int) -> bytes:
        return bundle(
            message(profile, "source", self._source),
            message(profile, "alive", *rows),
            *(message(profile, "set", session, *row) for session, row in rows.items()),
            message(profile, "fseq", fseq),
        )


class Tuio(Output):
    """Sends the fingers on the screen to a numeric host and a port, which need not listen; TUIO has no keys.

    `say` is called with each kind of failure, once, and again after a minute without any.
    """

    topics = ("touch", "health")

    def __init__(self, area: Area, to: tuple[str, int], name: str, now_ns: int, say: Callable[[str], object]) -> None:
        self._to, self._say = to, say
        self._failures: set[str] = set()
        self._failed, self._failed_ns = False, now_ns
        self._socket = socket.socket(socket.AF_INET6 if ":" in to[0] else socket.AF_INET, socket.SOCK_DGRAM)
        self._area = area
        self._frames = Frames(f"touchd:{name}@{to[0]}", area.size_mm, now_ns)
        self._last = self._frames.frame({}, now_ns)
        self._shown, self._sent_ns = False, now_ns
        self._send(self._frames.boundary())

    def show(self, down: Down, t_ns: int) -> None:
        """Send one frame."""
        self._last = self._frames.frame(self._area.places(down, t_ns), t_ns)
        self._send(self._last)
        self._shown = True

    def idle(self, now_ns: int) -> None:
        """Repeat the last frame, for a client that lost it or came later."""
        if self._failed:
            self._failed, self._failed_ns = False, now_ns
        elif self._failures and now_ns - self._failed_ns >= _FORGOTTEN_NS:
            self._failures.clear()
        if self._shown:
            self._shown, self._sent_ns = False, now_ns
        elif now_ns - self._sent_ns >= _REPEAT_NS:
            self._send(self._last)
            self._sent_ns = now_ns

    def close(self) -> None:
        """Say that nothing is down, and that the stream ends."""
        try:
            self._send(self._frames.frame({}, 0))
            self._send(self._frames.boundary())
        finally:
            self._socket.close()

    def _send(self, bundles: list[bytes]) -> None:
        for each in bundles:
            try:
                self._socket.sendto(each, self._to)
            except OSError as error:  # the network is down, for example: the next frame says all again
                self._failed = True
                if (failure := error.strerror or str(error)) not in self._failures:
                    self._failures.add(failure)
                    self._say(
                        f"touchd: TUIO does not reach {self._to[0]}:{self._to[1]} ({failure}), and goes on trying -> "
                        "check the network, and IPAddressAllow= of touchd-tuio.service"
                    )
                return
