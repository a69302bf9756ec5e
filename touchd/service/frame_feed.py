"""Hands the daemon's frames to another program of the same user, such as `record`: one process owns the device.

The program sends the command `frames` to the control socket, with one end of a pair of sockets. The daemon answers
there with a description, then with each frame, one message each. It never waits: a program that is too slow loses
frames, as their numbers tell, and one that reads nothing for a minute loses its place.
"""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import structlog
from pydantic import ValidationError

from touchd.config.schema import DeviceSettings, Settings
from touchd.errors import BusError, SourceError
from touchd.frame import Acquisition, Description, Frame, Plate
from touchd.recording.data import Device
from touchd.service.control import SERVICE_PATH, converse, path_of
from touchd.sources.open import SourceChoice
from touchd.sources.source import Source

COMMAND = b"frames"
MOST_LISTENERS = 4
_BUFFER_BYTES = 4_000_000
_ANSWER_S = 3.0
STUCK_NS = 60_000_000_000
"""A program that takes no frame for this time has stopped, and would hold its place for ever."""
_HEAD = struct.Struct("<qqq")
"""Of a message: sequence, t_ns and received_ns; the counts follow, int16."""

log = structlog.get_logger()


class FeedDescription(Description):
    """What frames a daemon hands out."""

    acquisition: Acquisition
    rate_hz: float
    source: str
    plate: Plate | None = None
    """None while the daemon is uncalibrated."""
    device: Device = Device()
    emitter_mm: tuple[float, float] | None = None
    receivers_mm: tuple[tuple[float, float], ...] = ()
    """Where the discs are, if the source knows."""
    keypad: bool = False
    """In keypad mode: touches tell a PIN."""


class FrameFeed:
    """The daemon's end; `describe` returns the description of the frames as they are now."""

    def __init__(self, describe: Callable[[], FeedDescription]) -> None:
        self.describe = describe
        self._keypad = False
        self.listeners: list[socket.socket] = []
        """Programs that get each frame."""
        self._behind_ns: dict[socket.socket, int] = {}  # since when each takes none

    def add(self, listener: socket.socket) -> None:
        """Hand all further frames to a program."""
        self._drop_gone()
        try:
            if len(self.listeners) >= MOST_LISTENERS:
                raise OSError(f"{MOST_LISTENERS} programs read already")
            listener.setblocking(False)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
            description = self.describe()
            self._keypad = description.keypad
            listener.send(description.model_dump_json().encode())
        except OSError as error:
            log.warning("no frames handed out", why=str(error))
            listener.close()
            return
        self.listeners.append(listener)
        log.info("frames are handed out: they can reveal a PIN", readers=len(self.listeners))

    def send(self, frame: Frame) -> None:
        """Send a frame to each program that can take it now."""
        head = _HEAD.pack(frame.sequence, frame.t_ns, frame.received_ns)
        counts = np.ascontiguousarray(frame.counts).data.cast("B")
        for listener in self.listeners[:]:
            try:
                listener.sendmsg([head, counts])
            except BlockingIOError:  # too slow: it misses this frame
                if frame.received_ns - self._behind_ns.setdefault(listener, frame.received_ns) >= STUCK_NS:
                    self._remove(listener)
            except OSError:
                self._remove(listener)
            else:
                if self._behind_ns:
                    self._behind_ns.pop(listener, None)

    def _drop_gone(self) -> None:
        """Close the ends of programs that have left: while no frame comes, no `send` finds out."""
        ends = select.poll()
        for listener in self.listeners:
            ends.register(listener, 0)  # POLLHUP and POLLERR come unasked
        gone = {descriptor for descriptor, _ in ends.poll(0)}
        for listener in [one for one in self.listeners if one.fileno() in gone]:
            self._remove(listener)

    def _remove(self, listener: socket.socket) -> None:
        self._behind_ns.pop(listener, None)
        self.listeners.remove(listener)
        listener.close()
        log.info("frames are no longer handed out", readers=len(self.listeners))

    def configured(self) -> None:
        """End all programs' streams if the plate has become a keypad: they may ask again, and are told so."""
        if self.listeners and self.describe().keypad and not self._keypad:
            self.close()

    def close(self) -> None:
        """End all programs' streams."""
        for listener in self.listeners:
            listener.close()
        self.listeners = []
        self._behind_ns.clear()


class DaemonSource(Source):
    """Frames of a running daemon, as a source; `feed` is the program's end of the pair.

    Raises BusError if the daemon does not answer: this user may not read its frames, or it is older than this program.
    """

    def __init__(self, feed: socket.socket) -> None:
        self._feed = feed
        feed.settimeout(_ANSWER_S)
        try:
            self.description = FeedDescription.model_validate_json(feed.recv(1 << 16))
        except (OSError, ValidationError) as error:
            feed.close()
            raise BusError(
                "the running daemon hands out no frames", "control.socket",
                "run this as the daemon's own user or as root, or stop the daemon",
            ) from error  # fmt: skip
        self.acquisition = self.description.acquisition
        self.device, self.rate_hz = self.description.device, self.description.rate_hz
        self._bytes = _HEAD.size + 2 * self.acquisition.channels * self.acquisition.samples

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame; None if none comes in time; SourceError once the daemon hands out no more."""
        self._feed.settimeout(timeout_s)
        try:
            message = self._feed.recv(self._bytes)
        except TimeoutError:
            return None
        except OSError:
            message = b""
        if len(message) != self._bytes:
            raise SourceError(
                "the daemon has ended, its plate is a keypad now, or this program stood still: no more frames come", "",
                "see the daemon's log, start it, and repeat the command",
            )  # fmt: skip
        counts = np.frombuffer(message, np.int16, offset=_HEAD.size).reshape(self.acquisition.shape)
        return Frame(counts, *_HEAD.unpack_from(message))

    def close(self) -> None:
        """Leave the daemon."""
        self._feed.close()


def rate_of(source: Source, settings: DeviceSettings) -> float:
    """Return the frame rate of a recording, a scene or the running daemon, or the configured one of a device, Hz."""
    return source.meta.frame_rate_hz if source.meta else source.rate_hz or settings.rate_hz


def open_running(choice: SourceChoice, settings: Settings) -> DaemonSource | None:
    """Return the frames of the running daemon, unless another source than the DAQ was chosen; None without a daemon."""
    return open_daemon(path_of(settings.control) or SERVICE_PATH) if choice.kind == "usb" else None


def open_daemon(control: Path) -> DaemonSource | None:
    """Ask the daemon that listens at a control socket for its frames; None if no daemon listens.

    Raises BusError if it hands out no frames.
    """
    try:
        mine = converse(control, COMMAND)
    except (FileNotFoundError, ConnectionRefusedError):
        return None
    except OSError as error:
        raise BusError(
            f"the running daemon cannot be asked for frames ({error.strerror or error})", str(control),
            "run this as the daemon's own user or as root",
        ) from error  # fmt: skip
    mine.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    return DaemonSource(mine)
