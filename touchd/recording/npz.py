"""Arrays out of a `.npz` that nobody vouches for.

`numpy.load` allocates whatever an array's header claims and lets half a dozen exception classes out. This reader
compares every claim with the archive before it allocates, never unpickles, and raises `RecordingError` only.
"""

from __future__ import annotations

import ast
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from touchd.errors import RecordingMissing, RecordingShape, RecordingTruncated, RecordingUnsafe

_MAGIC = b"\x93NUMPY"
_MAX_HEADER_BYTES = 4096
_READ_BYTES = 1 << 20
# Deflate cannot do better than 1032 to 1: an archive that claims more is lying.
_MAX_DEFLATE_RATIO = 1032
# A system that overcommits would grant more, and kill the process when it is used.
_MEMORY_BYTES = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
_DESCR = re.compile(r"[<>=|]?[biufcUS][0-9]*")
# What zipfile and zlib raise on damaged input; NotImplementedError is a RuntimeError.
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, RuntimeError, LookupError,
    OverflowError,
)  # fmt: skip


def load(path: Path, keys: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Read those of `keys` that the archive holds; other keys are not even looked at.

    Returns arrays in native byte order and C order, whatever the file's.

    Raises
    ------
    RecordingMissing
        There is no such file, or it may not be read.
    RecordingTruncated
        The file is not a whole archive.
    RecordingUnsafe
        A wanted array holds pickled objects.
    RecordingShape
        A wanted array's header is not one of a plain array of numbers or text, or claims what the file cannot hold.
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
            dtype, shape, fortran, header_bytes = _header(member, where)
            claimed_bytes, held_bytes = math.prod(shape) * dtype.itemsize, info.file_size - header_bytes
            if claimed_bytes != held_bytes:
                problem = f"claims {dtype} of shape {shape}, {claimed_bytes} bytes, but holds {held_bytes}"
                raise RecordingShape(problem, where, "write the recording again")
            if claimed_bytes > _MEMORY_BYTES:
                raise MemoryError
            array = np.empty(shape[::-1] if fortran else shape, dtype)
            data = array.reshape(-1).view(np.uint8).data if claimed_bytes else memoryview(b"")
            done = 0
            while done < claimed_bytes:
                part = member.read(min(_READ_BYTES, claimed_bytes - done))
                if not part:
                    _truncated(path, f"'{key}' ends early")
                data[done : done + len(part)] = part
                done += len(part)
            member.read(1)  # the end of the member, where its checksum is compared
    except MemoryError as error:
        raise RecordingShape("is larger than this machine's memory", where, "record into a folder of chunks") from error
    except _DAMAGE as error:
        _truncated(path, f"'{key}' is damaged", error)
    if fortran:
        array = array.T
    return np.ascontiguousarray(array, dtype.newbyteorder("=")).reshape(shape)


def _header(member: Any, where: str) -> tuple[np.dtype[Any], tuple[int, ...], bool, int]:
    """Parse an array's header: its type, shape, whether in Fortran order, and the header's own length in bytes."""

    def refuse(problem: str) -> NoReturn:
        raise RecordingShape(problem, where, "write the recording with numpy.savez")

    start = member.read(8)
    if len(start) < 8 or start[:6] != _MAGIC or start[6] not in (1, 2, 3):
        refuse("is not a numpy array")
    length = "<H" if start[6] == 1 else "<I"
    (text_bytes,) = struct.unpack(length, member.read(struct.calcsize(length)))
    if text_bytes > _MAX_HEADER_BYTES:
        refuse(f"has an array header of {text_bytes} bytes")
    text = member.read(text_bytes).decode("latin-1")
    # No header of a plain array holds a backslash, and the parser warns of bad ones.
    if "\\" in text:
        refuse("has a malformed array header")
    try:
        header = ast.literal_eval(text.strip())
        descr, fortran, shape = header["descr"], header["fortran_order"], header["shape"]
    except (ValueError, TypeError, SyntaxError, KeyError, RecursionError, MemoryError):
        refuse("has a malformed array header")
    if "O" in str(descr):
        raise RecordingUnsafe(
            "holds pickled Python objects, which could run code", where, "save plain arrays; do not load this file"
        )
    if not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        refuse("has a malformed array header")
    if not isinstance(descr, str) or not _DESCR.fullmatch(descr):
        refuse(f"is of type {str(descr)[:40]!r}, which no key of a recording has")
    try:
        dtype = np.dtype(descr)
    except (TypeError, ValueError, OverflowError):
        refuse(f"is of the unknown type {descr[:40]!r}")
    return dtype, shape, bool(fortran), member.tell()


def _truncated(path: Path, problem: str, error: Exception | None = None) -> NoReturn:
    reason = f" ({_reason(error)})" if error else ""
    raise RecordingTruncated(
        f"{problem}{reason}", str(path), "copy it again; a damaged chunk of a folder can be deleted"
    ) from error


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__
