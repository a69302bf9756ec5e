"""Takes commands from other programs: datagrams at a socket in the file system.

One datagram is one command, in ASCII: `screen off`, `screen on`, `reload`, which may bring a socket for the answer, and
`frames` with a socket for them. Whoever may write to the file may command; frames, which can reveal a PIN, are for the
daemon's own user and root alone.
"""

from __future__ import annotations

import array
import contextlib
import os
import socket
import struct
from pathlib import Path

import structlog

from touchd.config.schema import ControlSettings
from touchd.errors import BusError, BusTimeout, ConfigError, ModelError, TouchdError
from touchd.files import runtime_folder, socket_file
from touchd.sinks.kept_file import KeptSocketFile
from touchd.sinks.throttle import Throttle

COMMANDS = ("screen off", "screen on", "reload", "frames")
SERVICE_PATH = Path("/run/touchd/control")
"""The socket of the service that the package installs."""
_LONGEST_BYTES = 64
_PATIENCE_S = 2.0  # a daemon that hangs leaves its queue full
_LOADED_S = 10.0  # of a reload: a slow computer loads a model for seconds
_MOST_SAID = 4000
_MOST_PER_POLL = 16  # a flood of commands must not hold up a frame
_MOST_FDS = 4
_CREDENTIALS = struct.Struct("3i")  # struct ucred: pid, uid, gid
_ANCILLARY_BYTES = socket.CMSG_SPACE(_CREDENTIALS.size) + socket.CMSG_SPACE(_MOST_FDS * 4)

log = structlog.get_logger()


def path_of(settings: ControlSettings) -> Path | None:
    """Return the socket of a daemon: `control.socket`, else one in systemd's runtime folder, else None."""
    if settings.socket is not None:
        return settings.socket
    folder = runtime_folder()
    return folder and folder / "control"


def send(path: Path, command: str) -> None:
    """Send a command to the daemon that listens at `path`; BusError if none does, or this user may not command it."""
    try:
        converse(path, command.encode("ascii")).close()
    except OSError as error:
        raise BusError(
            f"no daemon takes commands there ({error.strerror or error})",
            str(path),
            "check that touchd runs, that control.socket has this path, and that control.group admits you",
        ) from error


def converse(path: Path, command: bytes) -> socket.socket:
    """Send a command with one end of a pair of sockets, and return the other, where the daemon answers.

    Raises FileNotFoundError or ConnectionRefusedError if no daemon listens, another OSError if it cannot be asked.
    """
    mine, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        with its, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.settimeout(_PATIENCE_S)
            sender.connect(str(path))
            socket.send_fds(sender, [command], [its.fileno()])
    except OSError:
        mine.close()
        raise
    return mine


def take_model(path: Path, model: Path) -> bool:
    """Have the daemon that listens at `path` take a model that was put in its place; return False if none listens.

    Raises ModelError if the daemon refuses the model, or uses another; BusTimeout if it does not answer in time;
    BusError if this user may not command it.
    """
    log = "see its log: journalctl -u touchd"
    try:
        with converse(path, b"reload") as daemon:
            daemon.settimeout(_LOADED_S)
            outcome, _, text = daemon.recv(4 * _MOST_SAID).decode(errors="surrogatepass").partition(" ")
    except (FileNotFoundError, ConnectionRefusedError):
        return False
    except TimeoutError as error:
        raise BusTimeout(f"{model} is there, but the running daemon has not taken it so far", str(path), log) from error
    except OSError as error:
        raise BusError(
            f"{model} is there, but the running daemon cannot be told ({error.strerror or error})", str(path),
            "systemctl reload touchd, or restart it",
        ) from error  # fmt: skip
    if outcome == "refused":
        raise ModelError(
            f"the running daemon refuses it, and uses what it used before ({text})", str(model),
            "mend that, or go back: touchd model rollback",
        )  # fmt: skip
    if outcome != "taken":
        raise BusError(
            f"{model} is there, but the running daemon has ended, or is older than this touchd", str(path), log
        )
    if text != os.path.realpath(model):
        raise ModelError(
            f"the running daemon uses {text or 'none'}", str(model), "give the daemon and this command one model.path"
        )
    return True


class Control:
    """The daemon's end, which replaces a socket that a dead daemon left behind.

    `group` may command too, beside the daemon's user; empty admits nobody else. Raises AddressInUse if another daemon
    listens there, ConfigError if the socket cannot be made, or given to the group.
    """

    def __init__(self, path: Path, group: str = "") -> None:
        self.path = path
        self.listeners: list[socket.socket] = []
        """Sockets that came with the commands `frames`, in order: take them from here."""
        self._asking: list[socket.socket] = []
        self._refused = Throttle("no such command, or not for this user")
        self._file: KeptSocketFile | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        where, fix = f"control.socket {path}", "set another control.socket"
        try:
            with socket_file(path, socket.SOCK_DGRAM, group, where, fix, ConfigError):
                self._socket.bind(str(path))
            self._file = KeptSocketFile(path, socket.SOCK_DGRAM)
        except TouchdError:
            self.close()
            raise

    def poll(self) -> list[str]:
        """Return the commands that have come, in order, without waiting; log and drop what is no command.

        A socket file that somebody has removed comes back.
        """
        try:
            if self._file is not None:
                self._file.look()
        except BusError as error:  # touches go on
            log.error("no command comes any more", error=str(error))
        found: list[str] = []
        for _ in range(_MOST_PER_POLL):
            try:
                said, ancillary, _, _ = self._socket.recvmsg(_LONGEST_BYTES, _ANCILLARY_BYTES, socket.MSG_CMSG_CLOEXEC)
            except OSError:  # none is left
                break
            command, (uid, handed) = said.decode("ascii", "replace").strip(), _unpack(ancillary)
            if command == "frames" and len(handed) == 1 and uid in (0, os.geteuid()):
                self.listeners.append(handed.pop())
                found.append(command)
            elif command in COMMANDS and command != "frames":
                found.append(command)
                if command == "reload":
                    self._asking += handed
                    continue
            else:
                self._refused.warn(known=COMMANDS)
            for unwanted in handed:
                unwanted.close()
        return found

    def answer(self, refused: str, model: Path | None) -> None:
        """Tell those who asked for a reload why it was refused, or which model is in use after it."""
        said = f"refused {refused}" if refused else f"taken {os.path.realpath(model) if model else ''}"
        asking, self._asking = self._asking, []
        for each in asking:
            with contextlib.suppress(OSError), each:  # whoever is gone, or hangs, misses it
                each.send(said[:_MOST_SAID].encode(errors="surrogatepass"), socket.MSG_DONTWAIT)

    def close(self) -> None:
        """Stop listening and remove the socket; further calls do nothing."""
        if self._socket.fileno() < 0:
            return
        for handed in (*self.listeners, *self._asking):
            handed.close()
        if self._file is not None:
            self._file.close()
        # Only this daemon's own file: another one may have taken the path meanwhile.
        with contextlib.suppress(OSError):
            if self._socket.getsockname() == str(self.path):
                self.path.unlink()
        self._socket.close()


def _unpack(ancillary: list[tuple[int, int, bytes]]) -> tuple[int, list[socket.socket]]:
    """Return the sender's user, -1 if unknown, and the sockets that it sent."""
    uid, handed = -1, []
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_CREDENTIALS and len(data) == _CREDENTIALS.size:
            _, uid, _ = _CREDENTIALS.unpack(data)
        elif level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            for fd in array.array("i", data[: len(data) // 4 * 4]):
                try:
                    handed.append(socket.socket(fileno=fd))
                except OSError:  # no socket
                    os.close(fd)
    return uid, handed
