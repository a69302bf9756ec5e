"""Socket files that somebody removes while a process listens at them: they come back."""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from pathlib import Path

import structlog

from touchd.errors import BusError, TouchdError
from touchd.files import clear_socket

log = structlog.get_logger()


class KeptSocketFile:
    """A socket file that comes back if somebody removes it: it has a second, hidden name.

    A script that tidies up removes it, or a program that binds where it should connect. Whoever listens hears nothing
    of that, and nobody finds it any more. A file system without hard links keeps nothing.
    """

    def __init__(self, path: Path, kind: socket.SocketKind) -> None:
        self._path, self._kind = path, kind
        self._second = path.with_name(f".{path.name}.kept")
        self._inode = path.lstat().st_ino
        with suppress(OSError):
            self._second.unlink(missing_ok=True)
            os.link(path, self._second)
        self._kept = self._is_there(self._second)

    def look(self) -> None:
        """Bring the file back if it is gone, or another process has left one that is dead in its place.

        Raises BusError, once, if the second name is gone, too: a restart makes the folder and all that is in it.
        """
        if self._is_there(self._path) or not self._kept:
            return
        try:
            clear_socket(self._path, self._kind, str(self._path), "", BusError)
            os.link(self._second, self._path)
        except TouchdError:
            return  # taken by somebody who lives; it comes back after that
        except OSError as error:
            if self._is_there(self._second):
                return  # of the folder's permissions, for example: they may come back
            self._kept = False
            raise BusError(
                "somebody has removed the socket's file, so nobody can connect any more", str(self._path),
                "start touchd again, as systemd does, and let nothing tidy up there",
            ) from error  # fmt: skip
        log.warning("somebody has removed the socket's file: it is back", path=str(self._path))

    def close(self) -> None:
        """Remove both names, unless another process has taken the first; further calls do nothing."""
        self._kept = False
        with suppress(OSError):
            if self._is_there(self._path):
                self._path.unlink()
        with suppress(OSError):
            self._second.unlink(missing_ok=True)

    def _is_there(self, path: Path) -> bool:
        with suppress(OSError):
            return os.lstat(path).st_ino == self._inode
        return False
