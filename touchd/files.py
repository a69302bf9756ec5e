"""Write files whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from touchd.errors import OutputError

CHECK = "check folder, space and permissions"


@contextmanager
def writing(path: Path, fix: str = CHECK) -> Iterator[None]:
    """Raise OutputError, with this remedy, where the system refuses to write `path`."""
    try:
        yield
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise OutputError(f"cannot be written ({reason})", str(path), fix) from error


@contextmanager
def replacing(path: Path, *, mode: int = 0o644, fix: str = CHECK) -> Iterator[IO[bytes]]:
    """Yield a file that takes the place of `path` once it is written and on disk; a power cut leaves all or nothing.

    Parameters
    ----------
    path : Path
    mode : int
        Permissions; until the file is in place, only its owner may read it.
    fix : str
        What the user can do if it cannot be written.

    Raises
    ------
    OutputError
        The file cannot be written. Nothing is left behind.
    """
    temporary = ""
    try:
        with writing(path, fix):
            # The dot keeps readers of a folder from taking it for one of its files.
            handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
            with os.fdopen(handle, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, mode)
            os.replace(temporary, path)
            temporary = ""
    finally:
        if temporary:
            with suppress(OSError):
                os.unlink(temporary)
    # The new name is safe once the folder is on disk too. Some file systems cannot sync one.
    with suppress(OSError):
        handle = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
