"""Write frames of any source to a file or folder."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

import numpy as np

from touchd.errors import OutputError
from touchd.files import check_output, writing
from touchd.frame import Acquisition, Frame, Plate
from touchd.recording import format as recording
from touchd.recording.data import Device, Meta, Recording
from touchd.sources.source import Source

CHUNK_FRAMES = 5000
"""Frames in a chunk of a folder: at 125 frames a second, a power cut costs at most 40 s."""
MAX_FILE_FRAMES = 60_000
"""Frames in a single file, which stays in memory until the end: 120 MB of 4 x 250 counts."""


def describe(
    acquisition: Acquisition,
    plate: Plate,
    frame_rate_hz: float,
    *,
    source: str,
    device: Device | None = None,
    notes: str = "",
) -> Meta:
    """Return the description of a recording that begins now."""
    said = acquisition.model_dump(exclude={"channels", "samples"})  # the frames say these
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return Meta(
        **said, frame_rate_hz=frame_rate_hz, plate=plate, source=source, device=device or Device(), created=created,
        notes=notes,
    )  # fmt: skip


def describe_source(source: Source, plate: Plate, frame_rate_hz: float, kind: str, notes: str = "") -> Meta:
    """Return the description of a recording of a source that begins now: the source's own, if it has one.

    Acts are of the frames that were recorded first.
    """
    known = source.meta
    fresh = describe(source.acquisition, plate, frame_rate_hz, source=kind, device=source.device, notes=notes)
    if known is None:
        return fresh
    changes = {"plate": plate, "source": kind, "created": fresh.created, "notes": notes or known.notes, "acts": ()}
    return known.model_copy(update=changes)


class Recorder:
    """Records frames.

    A path that ends in `.npz` becomes one file, written by `close`. Any other becomes a folder of numbered chunks; a
    thread writes each chunk as soon as it is full, so that no frame waits for the disk.

    `meta` describes the recording, see `describe`. Raises OutputError if the path exists already, or cannot be written.
    """

    def __init__(
        self, path: Path, meta: Meta, *, chunk_frames: int = CHUNK_FRAMES, max_file_frames: int = MAX_FILE_FRAMES
    ) -> None:
        self.meta = meta
        self.path = path
        """Where the frames are; of a single file another name, once `close` has found this one taken."""
        self.frames = 0
        """Frames recorded."""
        self.saved = 0
        """Frames on disk."""
        self.lost = 0
        """Frames that the source's counter skipped."""
        self.dropped = 0
        """Frames not recorded, because their number or time did not increase."""
        self._single = path.suffix == ".npz"
        self._chunk_frames = chunk_frames
        self._max_frames = max_file_frames if self._single else None
        self._kept: list[Frame] = []  # in memory
        self._chunks = 0
        self._last: Frame | None = None
        self._epoch_ns = 0
        self._writing: Future[Path] | None = None
        self._queued = 0  # frames that it writes
        self._writer = ThreadPoolExecutor(1, "touchd-recorder")
        try:
            self._writer.submit(int)  # the thread starts now: at the end, without one, the frames would be lost
        except RuntimeError as error:
            fix = "end programs of this user, or raise its limit: ulimit -u"
            raise OutputError(f"no thread can write it ({error})", str(path), fix) from error
        prepare(path, self._single)

    def keep(self, frame: Frame) -> None:
        """Record a frame.

        Raises OutputError if a chunk could not be written, or a single file is full; `close` still saves what is in
        memory.
        """
        if self._writing is not None and self._writing.done():
            self._finish_writing()
        if self._last is None:
            self._epoch_ns = frame.t_ns
        elif frame.sequence <= self._last.sequence or frame.t_ns <= self._last.t_ns:
            self.dropped += 1
            return
        if self.frames == self._max_frames:
            raise OutputError(
                f"is full: one file holds {self._max_frames} frames", str(self.path),
                "record into a folder: give a name that does not end in .npz",
            )  # fmt: skip
        if self._last is not None:
            self.lost += frame.sequence - self._last.sequence - 1
        self._kept.append(frame.copy())
        self._last = frame
        self.frames += 1
        if not self._single and len(self._kept) == self._chunk_frames:
            self._finish_writing()
            self._flush()

    def close(self) -> None:
        """Write the rest, or raise OutputError; without a frame no file is made. Further calls do nothing."""
        with ExitStack() as steps:  # from the last to the first, and each even if others fail
            steps.callback(self._remove_if_empty)
            steps.callback(self._writer.shutdown)
            steps.callback(self._finish_writing)
            steps.callback(self._flush)
            steps.callback(self._finish_writing)

    def _flush(self) -> None:
        """Queue the frames in memory for the writing thread."""
        frames, self._kept = self._kept, []
        if frames:
            self._writing = self._writer.submit(self._write, self._chunks, frames)
            self._queued = len(frames)
            self._chunks += 1

    def _write(self, number: int, frames: list[Frame]) -> Path:
        made = recording_of(self.meta, frames, self._epoch_ns)
        if self._single:
            return write_beside(self.path, made)
        recording.write(self.path / f"{number:06d}.npz", made)
        return self.path

    def _finish_writing(self) -> None:
        writing, self._writing = self._writing, None
        if writing is not None:
            self.path = writing.result()
            self.saved += self._queued

    def _remove_if_empty(self) -> None:
        if self.saved == 0 and not self._single:
            with suppress(OSError):
                self.path.rmdir()


class GrowingFile:
    """Writes a recording that grows to one file, whole each time: a power cut leaves the last one.

    The file is `path`, or another beside it, see `write_beside`. `begin` writes in a thread, so that no frame waits.
    """

    def __init__(self, path: Path) -> None:
        self.problem = ""
        """Why the thread could not write the last time."""
        self._path, self._ours = path, False
        self._writer = ThreadPoolExecutor(1, "touchd-recorder")
        self._writing: Future[None] | None = None

    @property
    def busy(self) -> bool:
        """Whether the thread writes."""
        return self._writing is not None and not self._writing.done()

    def begin(self, made: Recording) -> None:
        """Have the thread write the recording, quickly; it must not be busy."""
        self._writing = self._writer.submit(self._try, made)

    def finish(self, made: Recording) -> Path:
        """Write the recording, small, and return its path; may be called again where that fails."""
        self._writer.shutdown()
        return self._write(made, compress=True)

    def remove(self) -> None:
        """Remove the file, if it was written."""
        self._writer.shutdown()
        if self._ours:
            self._path.unlink(missing_ok=True)

    def _try(self, made: Recording) -> None:
        try:
            self._write(made, compress=False)
            self.problem = ""
        except OutputError as error:
            self.problem = str(error)

    def _write(self, made: Recording, *, compress: bool) -> Path:
        if self._ours:
            recording.write(self._path, made, compress=compress)
        else:
            self._path = write_beside(self._path, made, compress=compress)
            self._ours = True
        return self._path


def recording_of(meta: Meta, frames: list[Frame], epoch_ns: int) -> Recording:
    """Return frames as a recording whose time counts from `epoch_ns`."""
    counts = np.stack([frame.counts for frame in frames])
    sequence = np.array([frame.sequence for frame in frames], np.int64)
    timestamp_ns = np.array([frame.t_ns for frame in frames], np.int64) - epoch_ns
    return Recording(meta, counts, sequence, timestamp_ns)


def write_beside(path: Path, made: Recording, *, compress: bool = True) -> Path:
    """Write a file and return its path: `NAME-2.npz` or a higher number if another program has made `NAME.npz`.

    Raises what `recording.write` raises.
    """
    for number in count(1):
        free = path if number == 1 else path.with_stem(f"{path.stem}-{number}")
        try:
            recording.write(free, made, compress=compress, fresh=True)
            break
        except OutputError as error:
            if not isinstance(error.__cause__, FileExistsError):
                raise
    return free


def prepare(path: Path, single: bool) -> None:
    """Check the path now, not after an hour of recording; make the folder of chunks. Raises OutputError."""
    check_output(path, replace=False, fix="choose another name, or delete it first")
    if not single:
        with writing(path):
            path.mkdir(mode=0o700)
