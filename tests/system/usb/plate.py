"""What a plate sounds like, as a device sends it: untouched for as long as one likes, and under a finger."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from touchd.cli.demo import SESSION
from touchd.recording.format import read


def interleaved(counts: np.ndarray[tuple[int, ...], np.dtype[np.int16]]) -> bytes:
    """Counts of shape (channels, samples) in the order of the wire."""
    return counts.T.astype("<i2").tobytes()


def recorded() -> tuple[list[bytes], list[bytes]]:
    """The shipped session's untouched frames before the first touch, and those of its longest touch."""
    session = read(SESSION)
    assert session.contacts_mm is not None
    touched = ~np.isnan(session.contacts_mm[..., 0]).all(axis=1)
    edges = np.flatnonzero(np.diff(touched.astype(int), prepend=0, append=0))
    begin, end = max(zip(edges[::2], edges[1::2], strict=True), key=lambda run: int(run[1] - run[0]))
    # Well inside: while it goes down and up a finger presses less.
    frames = session.frames[begin + 20 : end - 20]
    return [interleaved(f) for f in session.frames[: edges[0] - 5]], [interleaved(f) for f in frames]


def write(folder: Path) -> tuple[Path, Path]:
    """Keep both in files, for a device in another process."""
    paths = folder / "untouched.bin", folder / "touched.bin"
    for path, frames in zip(paths, recorded(), strict=True):
        path.write_bytes(b"".join(frames))
    return paths
