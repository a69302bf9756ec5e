"""Score a recording in parts, as jobs: hours of frames on all cores, with progress; a run that is stopped goes on.

Parts meet where the plate is untouched. Each learns the plate in the minute before its first frame, as a daemon does
that was started then, so a part depends on nothing but its own files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from touchd.config.schema import Settings
from touchd.errors import RecordingShape, RecordingValues
from touchd.evaluation.dataset import beyond
from touchd.evaluation.replay_scores import StreamScores, joined, score_stream
from touchd.evaluation.truth import fingers_only
from touchd.event import TouchEvent
from touchd.frame import Frame
from touchd.jobs import Job, run
from touchd.localization.atlas import atlas_path
from touchd.recording import npz
from touchd.recording.data import ARRAYS, Recording
from touchd.recording.format import Reader, chunk_paths, join
from touchd.service.models import model_path
from touchd.service.replay import run_through
from touchd.sources.source import EndOfStream, Source
from touchd.twin.cache import parts_kept

PART_FRAMES = 100_000
"""Least number of frames in a part: 13 minutes at 125 a second."""
LEAD_NS = 60_000_000_000
"""Each part but the first begins this time early; what is found there belongs to the part before."""
CALM_NS = 2_000_000_000
"""Parts meet where no finger has touched for this time."""
_BEGIN_NS = 1_000_000_000
"""Time of a recording's first frame; 0 means none."""

Progress = Callable[[int, int], object]
"""Called with the number of frames done and of all frames."""


class Part(NamedTuple):
    """A run of a recording's frames, by their numbers."""

    files: list[str]
    """The chunks that hold it."""
    begin: int
    """The first frame to play."""
    first: int
    """The first frame to score."""
    last: int
    before: int
    """How many frames of the recording come before those that are scored."""
    frames: int
    """How many are scored."""


def score(
    path: Path, settings: Settings, *, workers: int | None = None, progress: Progress, part_frames: int = PART_FRAMES
) -> StreamScores:
    """Replay a labelled recording through the pipeline, and score it.

    A run that is stopped leaves the parts that have ended, and the next one of the same recording, model and settings
    goes on from there. Raises RecordingError if it cannot be used, or has no labels.
    """
    chosen, model = settings.model_dump(mode="json"), model_path(settings)
    parts = plan(path, part_frames)
    if len(parts) == 1:
        return score_part(parts[0], chosen)
    jobs = [
        Job(f"frames {part.first} to {part.last}", score_part, {
            "part": part, "settings": chosen,
            "versions": [
                (str(file), file.stat().st_size, file.stat().st_mtime_ns)
                for file in (model, atlas_path(model), *map(Path, part.files)) if file.exists()
            ],
        })
        for part in parts
    ]  # fmt: skip
    frames = {job.name: part.frames for job, part in zip(jobs, parts, strict=True)}
    done = 0

    def advance(name: str, _ended: int, _of: int) -> None:
        nonlocal done
        done += frames[name]
        progress(done, sum(frames.values()))

    with parts_kept("evaluate", [job.arguments for job in jobs]) as kept:
        found: list[StreamScores] = list(run(jobs, workers=workers, cache=kept, progress=advance).values())
    return joined(found)


def plan(path: Path, part_frames: int) -> list[Part]:
    """Divide a recording by its labels, which are all that is read; a single file is one part."""
    files = chunk_paths(path.absolute())
    labels = [_labels(file) for file in files]
    starts = np.cumsum([0, *(len(sequence) for sequence, _, _ in labels)])
    sequence, t_ns, touched = (np.concatenate(arrays) for arrays in zip(*labels, strict=True))
    latest_ns = np.maximum.accumulate(np.where(touched, t_ns, t_ns[0] - CALM_NS))
    calm = np.flatnonzero(t_ns - latest_ns >= CALM_NS)
    cuts = [0]
    while len(files) > 1 and (at := np.searchsorted(calm, cuts[-1] + part_frames)) < len(calm):
        cuts.append(int(calm[at]))
    parts = []
    for first, after in pairwise([*cuts, len(sequence)]):
        early = np.searchsorted(calm, np.searchsorted(t_ns, t_ns[first] - LEAD_NS, "right"))
        begin = int(calm[early - 1]) if first and early else 0
        low, high = np.searchsorted(starts, (begin, after - 1), "right") - 1
        played, scored, last = sequence[[begin, first, after - 1]].tolist()
        parts.append(Part([str(file) for file in files[low : high + 1]], played, scored, last, first, after - first))
    return parts


def score_part(part: Part, settings: dict[str, Any], versions: Sequence[Any] = ()) -> StreamScores:  # noqa: ARG001 - see below
    """Replay and score one part, as a job; what is kept of it is for these `versions` of its files."""
    span = _Span(part)
    events = run_through(span, Settings.model_validate(settings)).touches
    labels = fingers_only(span.labels())
    if labels.contacts_mm is not None and (outside := beyond(labels.contacts_mm.reshape(-1, 2), labels.meta.plate)):
        raise RecordingValues(outside, "contacts_mm", "correct the positions or the plate's size")
    return score_stream(labels, list(_of_part(events, part.first)))


def _of_part(events: Sequence[TouchEvent], first: int) -> Iterator[TouchEvent]:
    """Yield the messages from a frame on, without the contacts that went down before: they are the last part's."""
    before = {contact.id for event in events if event.frame < first for contact in event.contacts}
    for event in events:
        if event.frame >= first:
            yield structs.replace(event, contacts=[contact for contact in event.contacts if contact.id not in before])


class _Span(Source):
    """The frames of a part, as a source."""

    def __init__(self, part: Part) -> None:
        self._part = part
        files = [Path(file) for file in part.files]
        self._reader = Reader(files[0].parent, files)
        self.acquisition = self._reader.acquisition
        self._frames = self._play()
        self._scored: list[Recording] = []

    def read(self, timeout_s: float) -> Frame:  # noqa: ARG002 - frames are always there
        frame = next(self._frames, None)
        if frame is None:
            raise EndOfStream
        return frame

    def close(self) -> None:
        """Nothing is held."""

    def labels(self) -> Recording:
        """Return what is scored of the frames that were read, without their counts."""
        made, before = join(self._scored), self._part.before
        acts = [
            act.model_copy(update={"begin": max(act.begin - before, 0), "end": max(act.end - before, 0)})
            for act in made.meta.acts
        ]
        return replace(made, meta=made.meta.model_copy(update={"acts": tuple(acts)}))

    def _play(self) -> Iterator[Frame]:
        part = self._part
        for chunk in self._reader:
            begin, first, after = np.searchsorted(chunk.sequence, (part.begin, part.first, part.last + 1))
            kept = {name: array[first:after] for name in ARRAYS if (array := getattr(chunk, name)) is not None}
            self._scored.append(replace(chunk, **kept | {"frames": chunk.frames[:0]}))
            rows = zip(chunk.frames[begin:after], chunk.sequence[begin:after].tolist(),
                       chunk.timestamp_ns[begin:after].tolist(), strict=True)  # fmt: skip
            for counts, number, t_ns in rows:
                yield Frame(counts, number, _BEGIN_NS + t_ns, _BEGIN_NS + t_ns)


def _labels(path: Path) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return number and time of a chunk's frames, and whether a finger touches, shape (n,) each."""
    arrays = npz.load(path, ("sequence", "timestamp_ns", "contacts_mm"))
    if "contacts_mm" not in arrays:
        raise RecordingValues("no true contacts to compare with", str(path), "use a recording with contacts_mm")
    if arrays["contacts_mm"].shape[:1] != arrays["sequence"].shape or arrays["contacts_mm"].ndim != 3:
        raise RecordingShape("contacts_mm does not fit the frames", str(path), "see docs/formats.md")
    return arrays["sequence"], arrays["timestamp_ns"], np.isfinite(arrays["contacts_mm"]).any(axis=(1, 2))
