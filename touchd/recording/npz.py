"""Read arrays from a `.npz` of unknown origin.

`numpy.load` allocates what an array's header claims, and raises a dozen classes of exception. This reader compares each
claim with the archive before it allocates, never unpickles, and raises RecordingError alone.
"""

from __future__ import annotations

import io
import math
import os
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from touchd.errors import RecordingMissing, RecordingShape, RecordingTruncated, RecordingUnsafe

_HEADER_BYTES = 4096
"""The most that is read in search of an array's header. Those of plain arrays take 128."""
_READ_BYTES = 1 << 20
_MAX_RATIO, _MIN_BUDGET_BYTES = 64, 256 << 20
"""All arrays together may take this many times the file's size, or the 256 MiB of a file of frames that are all alike.
Frames of a plate compress by a factor of 5; Deflate, by 1032."""
MEMORY_BYTES = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
"""A system that overcommits grants more, and kills the process when it uses the memory."""
_KINDS = "biufcUS"
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, RuntimeError, LookupError,
    OverflowError,
)  # fmt: skip
"""What zipfile and zlib raise on damaged input; NotImplementedError is a RuntimeError."""


class _File(io.BufferedReader):
    """A file that is read in pieces: zipfile would read a directory of any size at once."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read up to `size` bytes, or to the end; raises BadZipFile for more than 1 MiB."""
        wanted = os.fstat(self.fileno()).st_size - self.tell() if size is None or size < 0 else size
        if wanted > _READ_BYTES:
            raise zipfile.BadZipFile(f"its directory takes {wanted} bytes")
        return super().read(size)


def load(path: Path, keys: Iterable[str], max_bytes: int | None = None) -> dict[str, NDArray[Any]]:
    """Read those of `keys` that the archive holds, in native byte order and C order. Other keys are not read.

    The sizes in the archive's directory are compared with `max_bytes`, by default a multiple of the file's size, before
    any array is read.

    Raises
    ------
    RecordingMissing
        There is no such file, or it may not be read.
    RecordingTruncated
        The file is not a whole archive.
    RecordingUnsafe
        A wanted array holds pickled objects.
    RecordingShape
        The header of a wanted array is not that of plain numbers or text, or claims more than the file holds.
    """
    try:
        # A pipe or a device would block, or never end.
        if not path.is_file():
            problem = "is not a file" if path.exists() else "no such file or folder"
            raise RecordingMissing(problem, str(path), "check the path")
        size_bytes = path.stat().st_size
        file = _File(io.FileIO(path))
    except (OSError, ValueError) as error:
        raise RecordingMissing(
            f"cannot be opened ({_reason(error)})", str(path), "check the path and its permissions"
        ) from error
    with file:
        try:
            archive = zipfile.ZipFile(file)
        except _DAMAGE as error:
            with suppress(OSError):  # of a disk that fails
                file.seek(0)
                if file.read(2) not in (b"", b"PK"):  # no part of an archive, but a text or a picture
                    raise RecordingTruncated(
                        "is no .npz archive", str(path), "name a recording: a .npz file, or its folder"
                    ) from error
            _truncated(path, "is not a whole .npz archive", error)
        with archive:
            names = set(archive.namelist())
            members = {key: archive.getinfo(f"{key}.npy") for key in keys if f"{key}.npy" in names}
            _check_sizes(members, path, size_bytes, max_bytes)
            return {key: _load(archive, key, info, path) for key, info in members.items()}


def _check_sizes(members: dict[str, zipfile.ZipInfo], path: Path, size_bytes: int, max_bytes: int | None) -> None:
    """Refuse an archive whose directory claims more than it can hold, or more than such a file may hold."""
    for key, info in members.items():
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            _truncated(path, f"'{key}' is compressed in a way that numpy does not write")
        stored = info.compress_type == zipfile.ZIP_STORED
        if info.compress_size > size_bytes or (stored and info.file_size > info.compress_size):
            _truncated(path, f"'{key}' claims {info.file_size} bytes, more than the file can hold")
    claimed_bytes = sum(info.file_size for info in members.values())
    if claimed_bytes > MEMORY_BYTES:
        raise too_large(path)
    if claimed_bytes > (max_bytes or max(_MAX_RATIO * size_bytes, _MIN_BUDGET_BYTES)):
        raise RecordingShape(
            f"claims {claimed_bytes} bytes of arrays, in a file of {size_bytes}", str(path),
            "do not load this file; a recording of nothing but zeros must be split into chunks",
        )  # fmt: skip


def too_large(path: Path) -> RecordingShape:
    """Return the error of a recording that memory does not hold."""
    return RecordingShape("is larger than this machine's memory", str(path), "record into a folder of chunks")


def _load(archive: zipfile.ZipFile, key: str, info: zipfile.ZipInfo, path: Path) -> NDArray[Any]:
    where = f"{path}: {key}"
    try:
        with archive.open(info) as member:
            # numpy reads a header of any length into memory: it gets the first bytes alone.
            head = io.BytesIO(member.read(_HEADER_BYTES))
            dtype, shape = _header(head, where)
            claimed_bytes, held_bytes = math.prod(shape) * dtype.itemsize, info.file_size - head.tell()
            if claimed_bytes != held_bytes:
                problem = f"claims {dtype} of shape {shape}, {claimed_bytes} bytes, but holds {held_bytes}"
                raise RecordingShape(problem, where, "write the recording again")
        # Of odd escapes, old names of types, and Python 2.
        with warnings.catch_warnings(action="ignore"), archive.open(info) as member:
            array = npy.read_array(member, allow_pickle=False, max_header_size=_HEADER_BYTES)
            member.read(1)  # the end, where its checksum is compared
    except MemoryError as error:
        raise too_large(path) from error
    except _DAMAGE as error:
        _truncated(path, f"'{key}' is damaged", error)
    return np.ascontiguousarray(array, dtype.newbyteorder("=")).reshape(shape)


def _header(head: io.BytesIO, where: str) -> tuple[np.dtype[Any], tuple[int, ...]]:
    """Return an array's type and shape. `head` then stands behind the header."""
    fix = "write the recording with numpy.savez"
    try:
        with warnings.catch_warnings(action="ignore"):  # of odd escapes, old names of types, and Python 2
            version, _ = npy.read_magic(head)
            read = {1: npy.read_array_header_1_0, 2: npy.read_array_header_2_0, 3: npy.read_array_header_2_0}[version]
            shape, _, dtype = read(head, max_header_size=_HEADER_BYTES)
    except Exception as error:  # numpy documents ValueError; its parsers raise a dozen other classes
        raise RecordingShape("has a malformed array header", where, fix) from error
    if dtype.hasobject:
        raise RecordingUnsafe(
            "holds pickled Python objects, which could run code", where, "save plain arrays; do not load this file"
        )
    if not all(type(n) is int and n >= 0 for n in shape):
        raise RecordingShape("has a malformed array header", where, fix)
    if dtype.kind not in _KINDS:
        raise RecordingShape(f"is of type {str(dtype)[:40]!r}, which no key of a recording has", where, fix)
    return dtype, shape


def _truncated(path: Path, problem: str, error: Exception | None = None) -> NoReturn:
    reason = f" ({_reason(error)})" if error else ""
    raise RecordingTruncated(
        f"{problem}{reason}", str(path), "copy it again; a damaged chunk of a folder can be deleted"
    ) from error


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__
