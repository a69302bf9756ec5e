"""Write files whole or not at all; read none that would hold a daemon up; make socket files."""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import re
import socket
import stat
import tempfile
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from touchd.errors import AddressInUse, BusError, ConfigError, OutputError, TouchdError

_PASSING = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENOMEM}
"""What no setting mends, and another try may find gone."""
CHECK = "check folder, space and permissions"
_PREFIX_BYTES = 100
_LOCK_TRIES, _LOCK_PAUSE_S = 200, 0.01
MOST_TEXT_BYTES = 1 << 20
"""No file of settings, keys or measures is as long."""
_TOML_ERROR = re.compile(r"(?P<what>.*) \(at (?P<place>line \d+, column \d+|end of document)\)", re.DOTALL)


def open_file(path: Path, flags: int = 0) -> IO[bytes]:
    """Open a regular file to read, without waiting: a pipe of its name would hold a daemon up for ever.

    Raises OSError if it cannot be opened, or is a folder, a pipe or a device.
    """
    # By an opener: a descriptor that `open` refuses to take, of a folder for one, would stay open.
    file = open(path, "rb", opener=lambda name, mode: os.open(name, mode | flags | os.O_NONBLOCK))  # noqa: SIM115 - returned
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return file


def runtime_folder() -> Path | None:
    """Return systemd's runtime folder of this service; None without one."""
    folder = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    return Path(folder) if folder else None


def state_folder(name: str) -> Path:
    """Return where a part keeps its state, a folder or a file: in systemd's state directory, else in the user's.

    Raises ConfigError of a user without a home folder.
    """
    if managed := os.environ.get("STATE_DIRECTORY"):
        return Path(managed.partition(":")[0]) / name
    try:
        home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    except RuntimeError as error:
        raise ConfigError("this user has no home folder", "environment: HOME", "set HOME, or XDG_STATE_HOME") from error
    return Path(home) / "touchd" / name


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8, without the byte order mark that some editors begin with.

    Raises OSError as `open_file` does, or for more than MOST_TEXT_BYTES; UnicodeDecodeError if it is no UTF-8.
    """
    with open_file(path) as file:
        content = file.read(MOST_TEXT_BYTES + 1)
    if len(content) > MOST_TEXT_BYTES:
        raise OSError(errno.EFBIG, "more than 1 MiB", str(path))
    return content.decode("utf-8-sig")


def read_toml(
    path: Path, refused: type[TouchdError], fix: str = "check the path and its permissions"
) -> dict[str, Any]:
    """Return the tables of a TOML file; raise `refused` if it cannot be read, with the place that is not TOML."""
    try:
        return tomllib.loads(read_text(path))
    except OSError as error:
        raise refused(f"cannot be read ({error.strerror})", str(path), fix) from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise refused("is not UTF-8", f"{path}: line {line}", "save the file as UTF-8") from error
    except (ValueError, RecursionError) as error:
        found = _TOML_ERROR.fullmatch(str(error))
        what = found["what"] if found else str(error)
        place = f"{path}: {found['place']}" if found else str(path)
        raise refused(f"is not valid TOML: {what[:1].lower()}{what[1:]}", place, "correct this line") from error


@contextmanager
def writing(path: Path, fix: str = CHECK) -> Iterator[None]:
    """Raise OutputError, with this remedy, where the system refuses to write `path`."""
    try:
        yield
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise OutputError(f"cannot be written ({reason})", str(path), fix) from error


def check_output(path: Path, *, replace: bool = True, fix: str = "choose another name, or add --force") -> None:
    """Raise OutputError if a file cannot be written, or exists and must not be replaced; then with this `fix`."""
    with writing(path):
        if not replace and (path.exists() or path.is_symlink()):
            raise OutputError("already there", str(path), fix)
        if path.is_dir():
            raise OutputError("is a folder", str(path), "name a file")
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise OutputError("not a writable folder", str(path.parent), "create it, or choose another name")


@contextmanager
def replacing(path: Path, *, mode: int = 0o644, fix: str = CHECK, fresh: bool = False) -> Iterator[IO[bytes]]:
    """Yield a file that takes the place of `path` once it is written and on disk; a power cut leaves all or nothing.

    Until the file is in place, only its owner may read it. Raises OutputError, with this `fix`, if it cannot be
    written; nothing is left behind. If `fresh`, a file that is there by then stays: the OutputError's cause is a
    FileExistsError.
    """
    left: list[str | Path] = []  # what a failure leaves behind
    # Its name is no longer than the file system allows, and no character of it is cut.
    prefix = os.fsencode(path.name)[:_PREFIX_BYTES].decode(errors="ignore")
    try:
        with writing(path, fix):
            # The dot keeps readers of a folder from taking it for one of its files.
            handle, temporary = tempfile.mkstemp(prefix=f".{prefix}.", suffix=".tmp", dir=path.parent)
            left.append(temporary)
            with os.fdopen(handle, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, mode)
            if fresh:  # not by a hard link, which a USB stick's file system lacks
                os.close(os.open(path, os.O_CREAT | os.O_EXCL, mode))
                left.append(path)
            os.replace(temporary, path)
            left.clear()
    finally:
        for name in left:
            with suppress(OSError):
                os.unlink(name)
    # The new name is safe once the folder is on disk too. Some file systems cannot sync one.
    with suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def is_missing(path: Path) -> bool:
    """Return whether nothing is at a path; what this user may not look at is not missing: to open it says why."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return True
    except OSError:
        pass
    return False


def stamps_of(*paths: Path) -> tuple[tuple[int, int, int] | None, ...]:
    """Return what tells files from others at the same paths; None for one that is not there."""
    found: list[tuple[int, int, int] | None] = []
    for path in paths:
        try:
            told = path.stat()
            found.append((told.st_ino, told.st_mtime_ns, told.st_size))
        except OSError:
            found.append(None)
    return tuple(found)


@contextmanager
def socket_file(
    path: Path, kind: socket.SocketKind, group: str, where: str, fix: str, refused: type[TouchdError]
) -> Iterator[None]:
    """Bind a socket file within this context, in place of that of a process that is gone, and of nothing else.

    It has mode 0600 from its first moment. With a group, the group is set first and mode 0660 last. The umask is that
    of the whole process: bind before other threads make files.

    Raises AddressInUse if a process listens there, or the socket is another user's; `refused` if path or group cannot
    be used; BusError if the file system is full, for example, which may pass. The messages have `where` and `fix`.
    """
    try:
        gid = grp.getgrnam(group).gr_gid if group else None
    except KeyError:
        raise refused(f"there is no group {group!r}", where, f"correct it, or create it: groupadd {group}") from None
    with _one_at_a_time(path.parent):
        clear_socket(path, kind, where, fix, refused)
        umask = os.umask(0o177)
        try:
            yield
        except OSError as error:
            kind_of = BusError if error.errno in _PASSING else refused
            raise kind_of(f"no socket can be made there ({error.strerror or error})", where, fix) from error
        finally:
            os.umask(umask)
    try:
        if gid is not None:
            if path.stat().st_gid != gid:  # the service's sandbox forbids to ask, and its files have its group
                os.chown(path, -1, gid)
            path.chmod(0o660)
    except OSError as error:
        what = f"the socket cannot be given to the group {group!r} ({error.strerror})"
        raise refused(what, where, "run touchd as a member of it") from error


def clear_socket(path: Path, kind: socket.SocketKind, where: str, fix: str, refused: type[TouchdError]) -> None:
    """Remove the socket file of a process that is gone.

    Raises AddressInUse if a process listens there, or the socket is another user's; `refused` of anything else there.
    """
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise refused("there is something else than a socket, and it is not replaced", where, fix)
        with socket.socket(socket.AF_UNIX, kind | socket.SOCK_NONBLOCK) as probe:
            try:
                probe.connect(str(path))
            except ConnectionRefusedError:
                path.unlink(missing_ok=True)
                return
            except BlockingIOError:  # a live publisher may have a full queue
                pass
    except FileNotFoundError:
        return
    except OSError as error:
        if error.errno == errno.EACCES and os.path.lexists(path):
            raise AddressInUse(
                "a socket of another user lies there", where, f"stop its owner and remove it, or {fix}"
            ) from error
        raise refused(f"the socket cannot be used ({error.strerror or error})", where, fix) from error
    raise AddressInUse("another process listens there", where, f"stop it (is it running already?), or {fix}")


@contextmanager
def held(folder: Path, owner: str, fix: str) -> Iterator[None]:
    """Keep a folder of files for this process within this context, by a lock that ends with the process.

    Raises OutputError, with this `fix`, if another process holds it, the `owner`, or if no lock can be made there.
    """
    with ExitStack() as stack:
        # Not the folder itself: whoever makes a socket file in it locks that.
        with writing(folder / ".lock", fix):
            lock = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            stack.callback(os.close, lock)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise OutputError(f"{owner} keeps its files there", str(folder), fix) from None
        yield


@contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Keep other processes of touchd from looking at and making socket files in a folder meanwhile.

    Of two that start at once each would find nothing there, and the second take the file from the first. Whoever holds
    the lock for long is a stranger: it is not waited for.
    """
    with ExitStack() as stack:
        with suppress(OSError, ValueError):  # what is wrong with the folder is said by whoever makes the file
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, lock)
            for _ in range(_LOCK_TRIES):
                with suppress(BlockingIOError):
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                time.sleep(_LOCK_PAUSE_S)
        yield
