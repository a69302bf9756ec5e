"""Results of jobs on disk: each written whole when its job ends, and checked when it is read."""

from __future__ import annotations

import contextlib
import grp
import hashlib
import os
import pwd
import stat
from pathlib import Path

import structlog

from touchd.errors import OutputError
from touchd.files import open_file, replacing

log = structlog.get_logger()

MAGIC = b"touchd job 1\n"
_HEAD = len(MAGIC) + hashlib.sha256().digest_size
ROOT_UID = 0


class Store:
    """A folder of pickled results. To unpickle is to run what a file says, so nobody else may be able to write there.

    It is made when the first result is written, closed to others. Symbolic links are resolved once, here. Raises
    OutputError if another user could write results there, or exchange the folder or one that it lies in.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self._complained = False
        for path in (self.folder, *self.folder.parents):
            with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
                reason = _unsafe_folder(path.stat(), is_parent=path != self.folder)
                if reason:
                    raise OutputError(
                        f"{reason}, and a result kept in {self.folder} could run that user's code", str(path),
                        f"choose another folder, or close this one if it is yours: chmod go-w {path}",
                    )  # fmt: skip

    def load(self, key: str) -> bytes | None:
        """Return a pickled result; None, with the reason in the log, if it is damaged or not this user's alone."""
        path = self._path(key)
        try:
            with open_file(path, os.O_NOFOLLOW) as file:
                reason = _unsafe_file(os.fstat(file.fileno()))
                content = b"" if reason else file.read()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            reason, content = str(error.strerror), b""
        data = content[_HEAD:]
        if not reason and content[:_HEAD] != MAGIC + hashlib.sha256(data).digest():
            reason = "it is damaged"
        if reason:
            log.warning("a stored result is computed again", reason=reason, path=path)
            return None
        return data

    def save(self, key: str, data: bytes) -> None:
        """Write a result to a temporary name, then rename: a reader sees the whole file or none.

        A folder that cannot be written costs the kept results, not the run; that is logged once.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            with replacing(self._path(key), mode=0o600) as file:
                file.write(MAGIC + hashlib.sha256(data).digest() + data)
        except (OSError, OutputError) as error:
            if not self._complained:
                what = "results cannot be kept: a run that is stopped starts over"
                log.warning(what, path=self.folder, error=str(error))
            self._complained = True

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.result"


def _unsafe_folder(status: os.stat_result, *, is_parent: bool) -> str:
    """Return why another user could change entries of a folder, or "".

    In a parent with the sticky bit, such as /tmp, others cannot exchange what is this user's. Root may do everything.
    """
    if status.st_uid != os.geteuid() and not (is_parent and status.st_uid == ROOT_UID):
        return "the folder belongs to another user"
    if _others_write(status) and not (is_parent and status.st_mode & stat.S_ISVTX):
        return "other users may write to the folder"
    return ""


def _unsafe_file(status: os.stat_result) -> str:
    """Return why another user could have written a file, or ""."""
    if status.st_uid != os.geteuid():
        return "it belongs to another user"
    return "other users may write to it" if _others_write(status) else ""


def _others_write(status: os.stat_result) -> bool:
    """Whether anybody else may write; a group that is the user's own, as on many systems, is nobody else."""
    if status.st_mode & stat.S_IWGRP:
        try:
            user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(status.st_gid)
        except KeyError:
            return True
        if group.gr_gid != user.pw_gid or group.gr_name != user.pw_name or set(group.gr_mem) - {user.pw_name}:
            return True
    return bool(status.st_mode & stat.S_IWOTH)
