"""Results of jobs on disk: each written whole when its job ends, and checked when it is read."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path

import structlog

from touchd.errors import OutputError

log = structlog.get_logger()

MAGIC = b"touchd job 1\n"
_HEAD = len(MAGIC) + hashlib.sha256().digest_size


class Store:
    """A folder of pickled results, for this user only.

    To unpickle is to run what the file says. So a folder is refused in which somebody else may write.

    Parameters
    ----------
    folder : Path
        Made when the first result is written, closed to all others.

    Raises
    ------
    OutputError
        When the folder is another user's, or others may write there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._complained = False
        with contextlib.suppress(OSError):  # absent, or not to be looked at: then nothing is read from it either
            status = folder.stat()
            if status.st_uid != os.geteuid() or status.st_mode & 0o022:
                raise OutputError(
                    "others may write there, and what results are read from there could run code of theirs",
                    str(folder),
                    f"choose another folder, or close it: chmod 700 {folder}",
                )

    def load(self, key: str) -> bytes | None:
        """Return a pickled result; None if it is not there, or damaged, which is logged."""
        path = self._path(key)
        try:
            content = path.read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            self._complain("a stored result cannot be read", path, error)
            return None
        data = content[_HEAD:]
        if content[:_HEAD] != MAGIC + hashlib.sha256(data).digest():
            log.warning("a stored result is damaged, and is computed again", path=path)
            return None
        return data

    def save(self, key: str, data: bytes) -> None:
        """Write a result to a temporary name, then rename: a reader sees the whole file or none.

        A folder that cannot be written costs the results' being kept, not the run; that is logged once.
        """
        path = self._path(key)
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            handle, temporary = tempfile.mkstemp(dir=self.folder, prefix=".part-")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(MAGIC + hashlib.sha256(data).digest() + data)
                os.replace(temporary, path)
            except BaseException:
                with contextlib.suppress(OSError):
                    os.unlink(temporary)
                raise
        except OSError as error:
            self._complain("results cannot be kept: a run that is stopped begins anew", self.folder, error)

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.result"

    def _complain(self, what: str, path: Path, error: OSError) -> None:
        if not self._complained:
            log.warning(what, path=path, error=error.strerror)
        self._complained = True
