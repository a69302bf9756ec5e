"""Read and write recordings, version 1: a `.npz` file, or a folder of numbered ones. See docs/formats.md."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from touchd.errors import RecordingMissing, RecordingShape, RecordingValues, RecordingVersion
from touchd.files import replacing
from touchd.recording import npz
from touchd.recording.data import ARRAYS, REQUIRED, Meta, Recording, check, check_continues

FORMAT = "touchd-recording"
VERSION = 1
_CHUNK_NAME = re.compile(r"(?!\.)(?:.*[^0-9])?([0-9]+)\.npz", re.DOTALL)


def write(path: Path, recording: Recording, *, compress: bool = True, fresh: bool = False) -> None:
    """Write one file, readable by its owner alone. A power cut leaves all or nothing.

    An existing file is replaced, or kept if `fresh`, see `replacing`.

    Raises RecordingShape or RecordingValues if the recording breaks the format (nothing is written); OutputError if the
    file cannot be written (nothing is left behind).
    """
    check(recording, str(path))
    arrays: dict[str, Any] = {name: getattr(recording, name) for name in ARRAYS}
    arrays = {name: array for name, array in arrays.items() if array is not None}
    save = np.savez_compressed if compress else np.savez
    with replacing(path, mode=0o600, fresh=fresh) as file:
        save(file, format=FORMAT, version=VERSION, meta=recording.meta.model_dump_json(), **arrays)


def read(path: Path) -> Recording:
    """Read a whole recording, a file or a folder of chunks, into memory.

    Raises a subclass of RecordingError, see `touchd.errors`.
    """
    chunks, size_bytes = [], 0
    for chunk in Reader(path):
        chunks.append(chunk)
        size_bytes += chunk.frames.nbytes
        if len(chunks) > 1 and 2 * size_bytes > npz.MEMORY_BYTES:  # they are copied into one array
            raise npz.too_large(path)
    return join(chunks)


def join(chunks: Sequence[Recording]) -> Recording:
    """Return chunks that follow each other as one recording."""
    if len(chunks) == 1:
        return chunks[0]
    arrays = {
        name: np.concatenate([getattr(chunk, name) for chunk in chunks])
        for name in ARRAYS
        if getattr(chunks[0], name) is not None
    }
    return Recording(meta=chunks[0].meta, **arrays)


class Reader:
    """Iterates over the chunks of a recording, one in memory at a time. A file is one chunk.

    Each iteration starts at the first chunk, which stays in memory: a single file is read once. `path` is a `.npz`
    file, or a folder of files whose names end in a number; `files` are some of these that follow each other, instead of
    all. Raises a subclass of RecordingError: on construction for the first chunk, during iteration for the others.
    """

    def __init__(self, path: Path, files: Sequence[Path] = ()) -> None:
        self.path = path
        self.chunk_paths = list(files) or chunk_paths(path)
        self._first = _read_file(self.chunk_paths[0])
        self.meta = self._first.meta
        self.acquisition = self._first.acquisition

    def __iter__(self) -> Iterator[Recording]:
        """Yield the chunks in order."""
        previous, previous_path = self._first, self.chunk_paths[0]
        yield previous
        for path in self.chunk_paths[1:]:
            chunk = _read_file(path)
            check_continues(previous, previous_path, chunk, path)
            yield chunk
            previous, previous_path = chunk, path


def chunk_paths(path: Path) -> list[Path]:
    """Return the files of a recording, in order."""
    try:
        if not path.is_dir():
            return [path]
        matches = [(match, entry) for entry in path.iterdir() if (match := _CHUNK_NAME.fullmatch(entry.name))]
    except (OSError, ValueError) as error:
        raise RecordingMissing(f"cannot be listed ({error})", str(path), "check the permissions") from error
    if not matches:
        raise RecordingMissing(
            "this folder holds no numbered .npz chunks", str(path), "name a recording: a .npz file, or its folder"
        )
    return [entry for _, entry in sorted(matches, key=lambda m: (int(m[0][1]), m[1].name))]


def _read_file(path: Path) -> Recording:
    where = str(path)
    arrays = npz.load(path, ("format", "version", "meta", *ARRAYS))
    kind = _scalar(arrays, "format", "U", where) if "format" in arrays else None
    if kind != FORMAT:
        found = f"is the format {str(kind)[:40]!r}" if kind is not None else "has no key 'format'"
        raise RecordingVersion(f"{found}: not a touchd recording", where, "see docs/formats.md for what one holds")
    version = _scalar(arrays, "version", "iu", where)
    if version != VERSION:
        fix = "upgrade touchd" if version > VERSION else "record it again"
        raise RecordingVersion(f"is version {version} of the format; this touchd reads version {VERSION}", where, fix)
    for name in REQUIRED:
        if name not in arrays:
            raise _missing_key(name, where)
    meta = _parse_meta(_scalar(arrays, "meta", "U", where), where)
    content: dict[str, Any] = {name: arrays[name] for name in ARRAYS if name in arrays}
    recording = Recording(meta=meta, **content)
    check(recording, where)
    return recording


def _scalar(arrays: dict[str, NDArray[Any]], key: str, kinds: str, where: str) -> Any:
    if key not in arrays:
        raise _missing_key(key, where)
    array = arrays[key]
    if array.shape != () or array.dtype.kind not in kinds:
        wanted = "text" if kinds == "U" else "a whole number"
        found = f"{array.dtype} of shape {array.shape}"
        raise RecordingShape(
            f"is {found}, must be {wanted} of shape ()", f"{where}: {key}", "write it with numpy.savez"
        )
    try:
        return array.item()
    except ValueError as error:
        raise RecordingValues("is not valid text", f"{where}: {key}", "write the recording again") from error


def _missing_key(key: str, where: str) -> RecordingShape:
    return RecordingShape(f"the key '{key}' is missing", where, "see docs/formats.md for what a recording holds")


def _parse_meta(text: str, where: str) -> Meta:
    try:
        return Meta.model_validate_json(text)
    except ValidationError as error:
        problems = [
            f"{'.'.join(map(str, e['loc'])) or 'meta'}: {e['msg'][:1].lower()}{e['msg'][1:]}"
            for e in error.errors(include_url=False, include_context=False)
        ]
        raise RecordingValues("; ".join(problems), f"{where}: meta", "correct these keys of the JSON object") from error
    except ValueError as error:  # lone surrogates cannot be encoded for the JSON parser
        raise RecordingValues("is not valid text", f"{where}: meta", "write the recording again") from error
