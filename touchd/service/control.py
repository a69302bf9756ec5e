"""What the administrator's programs tell a running daemon: datagrams at a socket in the file system.

One datagram is one command, in ASCII: `screen off`, `screen on`. Who may write to the file may command.
"""

from __future__ import annotations

import contextlib
import grp
import os
import socket
import stat
from pathlib import Path

import structlog

from touchd.config.schema import ControlSettings
from touchd.errors import AddressInUse, BusError, ConfigError

COMMANDS = ("screen off", "screen on")
SERVICE_PATH = Path("/run/touchd/control")
"""Of the service that the package installs."""
_LONGEST_BYTES = 64
_PATIENCE_S = 2.0  # a daemon that hangs leaves its queue full
_MOST_PER_POLL = 16  # a flood of commands must not hold up a frame

log = structlog.get_logger()


def path_of(settings: ControlSettings) -> Path | None:
    """Return where a daemon with these settings listens: systemd's runtime folder unless named, None without either."""
    if settings.socket is not None:
        return settings.socket
    folder = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    return Path(folder) / "control" if folder else None


def send(path: Path, command: str) -> None:
    """Tell the daemon that listens there.

    Raises
    ------
    BusError
        If none does, or this user may not.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.settimeout(_PATIENCE_S)
            sender.sendto(command.encode("ascii"), str(path))
    except OSError as error:
        raise BusError(
            f"no daemon takes commands there ({error.strerror or error})",
            str(path),
            "check that touchd runs, that control.socket has this path, and that control.group admits you",
        ) from error


class Control:
    """The daemon's end.

    Parameters
    ----------
    path : Path
        Of the socket; one that a daemon left behind is replaced.
    group : str
        May write to it beside the daemon's user; empty admits nobody else.

    Raises
    ------
    AddressInUse
        If another daemon listens there.
    ConfigError
        If the socket cannot be made, or given to the group.
    """

    def __init__(self, path: Path, group: str = "") -> None:
        self.path = path
        _clear(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        umask = os.umask(0o177)
        try:
            self._socket.bind(str(path))
            if group:
                os.chown(path, -1, grp.getgrnam(group).gr_gid)
                path.chmod(0o660)
        except (OSError, KeyError) as error:
            self.close()
            why = f"there is no group {group!r}" if isinstance(error, KeyError) else error.strerror or str(error)
            raise ConfigError(
                f"cannot be made ({why})", f"control.socket {path}", "correct control.socket or control.group"
            ) from error
        finally:
            os.umask(umask)

    def poll(self) -> list[str]:
        """Return the commands that have come, in order, without waiting; others are logged and passed over."""
        found: list[str] = []
        for _ in range(_MOST_PER_POLL):
            try:
                command = self._socket.recv(_LONGEST_BYTES).decode("ascii", "replace").strip()
            except OSError:  # none is left
                break
            if command in COMMANDS:
                found.append(command)
            else:
                log.warning("no such command", known=COMMANDS)
        return found

    def close(self) -> None:
        """Listen no more; further calls do nothing."""
        if self._socket.fileno() < 0:
            return
        # Only one's own file: another daemon may have taken the path meanwhile.
        with contextlib.suppress(OSError):
            if self._socket.getsockname() == str(self.path):
                self.path.unlink()
        self._socket.close()


def _clear(path: Path) -> None:
    """Remove the socket of a daemon that is gone; nothing else is removed."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise ConfigError("there is something else than a socket", f"control.socket {path}", "name another path")
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
            probe.connect(str(path))
    except FileNotFoundError:
        return
    except ConnectionRefusedError:
        path.unlink(missing_ok=True)
        return
    except OSError as error:
        raise ConfigError(
            f"cannot be made ({error.strerror or error})", f"control.socket {path}", "check the path and its owner"
        ) from error
    raise AddressInUse(
        "another process takes commands there", str(path), "stop it (is the daemon running already?), or set another "
        "control.socket",
    )  # fmt: skip
