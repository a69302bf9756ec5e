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
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from touchd.errors import RecordingMissing, RecordingShape, RecordingTruncated, RecordingUnsafe

_HEADER_BYTES = 4096
"""The most that is read in search of an array's header. Those of plain arrays take 128."""
_READ_BYTES = 1 << 20
_MAX_DEFLATE_RATIO = 1032
"""The most that Deflate compresses, https://zlib.net/zlib_tech.html. An archive that claims more is hostile."""
_MEMORY_BYTES = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
"""A system that overcommits grants more, and kills the process when it uses the memory."""
_KINDS = "biufcUS"
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, RuntimeError, LookupError,
    OverflowError,
)  # fmt: skip
"""What zipfile and zlib raise on damaged input; NotImplementedError is a RuntimeError."""


def load(path: Path, keys: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Read those of `keys` that the archive holds, in native byte order and C order. Other keys are not read.

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
        file = path.open("rb")
    except (OSError, ValueError) as error:
        raise RecordingMissing(
            f"cannot be opened ({_reason(error)})", str(path), "check the path and its permissions"
        ) from error
    with file:
        try:
            archive = zipfile.ZipFile(file)
        except _DAMAGE as error:
            _truncated(path, "is not a whole .npz archive", error)
        with archive:
            names = set(archive.namelist())
            return {key: _load(archive, key, path, size_bytes) for key in keys if f"{key}.npy" in names}


def _load(archive: zipfile.ZipFile, key: str, path: Path, size_bytes: int) -> NDArray[Any]:
    where = f"{path}: {key}"
    info = archive.getinfo(f"{key}.npy")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        _truncated(path, f"'{key}' is compressed in a way that numpy does not write")
    ratio = _MAX_DEFLATE_RATIO if info.compress_type == zipfile.ZIP_DEFLATED else 1
    if info.compress_size > size_bytes or info.file_size > ratio * info.compress_size:
        _truncated(path, f"'{key}' claims {info.file_size} bytes, more than the file can hold")
    try:
        with archive.open(info) as member:
            # numpy reads a header of any length into memory: it gets the first bytes alone.
            head = io.BytesIO(member.read(_HEADER_BYTES))
            dtype, shape, fortran = _header(head, where)
            claimed_bytes, held_bytes = math.prod(shape) * dtype.itemsize, info.file_size - head.tell()
            if claimed_bytes != held_bytes:
                problem = f"claims {dtype} of shape {shape}, {claimed_bytes} bytes, but holds {held_bytes}"
                raise RecordingShape(problem, where, "write the recording again")
            if claimed_bytes > _MEMORY_BYTES:
                raise MemoryError
            array = np.empty(shape[::-1] if fortran else shape, dtype)
            data = array.reshape(-1).view(np.uint8).data if claimed_bytes else memoryview(b"")
            part, done = head.read(), 0
            while part:  # to the end of the member, where its checksum is compared
                data[done : done + len(part)] = part
                done += len(part)
                part = member.read(_READ_BYTES)
            if done < claimed_bytes:
                _truncated(path, f"'{key}' ends early")
    except MemoryError as error:
        raise RecordingShape("is larger than this machine's memory", where, "record into a folder of chunks") from error
    except _DAMAGE as error:
        _truncated(path, f"'{key}' is damaged", error)
    if fortran:
        array = array.T
    return np.ascontiguousarray(array, dtype.newbyteorder("=")).reshape(shape)


def _header(head: io.BytesIO, where: str) -> tuple[np.dtype[Any], tuple[int, ...], bool]:
    """Return an array's type, its shape, and whether it is in Fortran order. `head` then stands behind the header."""
    fix = "write the recording with numpy.savez"
    try:
        with warnings.catch_warnings(action="ignore"):  # of odd escapes, old names of types, and Python 2
            version, _ = npy.read_magic(head)
            read = {1: npy.read_array_header_1_0, 2: npy.read_array_header_2_0, 3: npy.read_array_header_2_0}[version]
            shape, fortran, dtype = read(head, max_header_size=_HEADER_BYTES)
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
    return dtype, shape, fortran


def _truncated(path: Path, problem: str, error: Exception | None = None) -> NoReturn:
    reason = f" ({_reason(error)})" if error else ""
    raise RecordingTruncated(
        f"{problem}{reason}", str(path), "copy it again; a damaged chunk of a folder can be deleted"
    ) from error


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__
