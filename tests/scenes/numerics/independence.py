"""What must not depend on how the work is cut up: networks by batch and threads, events by threads and chunks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnxruntime as ort
from msgspec import structs
from numpy.typing import NDArray

from tests.scenes.stages import Given, frames_of, shipped
from touchd.config.schema import Settings
from touchd.event import TouchEvent
from touchd.frame import Frame
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Recording
from touchd.recording.format import write
from touchd.service.replay import run_through
from touchd.sources.replay import ReplaySource
from touchd.sources.source import Source

Rows = NDArray[np.float32]
Contacts = list[tuple[int, list[tuple[float | str, ...]]]]


def batched(features: Rows, batch: int, threads: int) -> NDArray[np.float64]:
    """Places (n, 2) of the shipped network, so many touches at a time on so many threads."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    session = ort.InferenceSession(str(default_model_path()), options, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    parts = [
        session.run(["position_mm"], {name: features[i : i + batch]})[0] for i in range(0, len(features), batch)
    ]  # fmt: skip
    return np.concatenate(parts).astype(np.float64)


def by_batch_and_threads(features: Rows) -> list[float]:
    """Largest distances of the network's places from those that it gives one by one on one thread, as a daemon asks."""
    plain = Model(default_model_path(), atlas=False).run(features)["position_mm"]
    return [
        float(np.linalg.norm(batched(features, batch, threads) - plain, axis=1).max())
        for batch in (1, 7, 64, len(features)) for threads in (1, 2)
    ]  # fmt: skip


def contacts_of(touches: Sequence[TouchEvent]) -> Contacts:
    """All numbers of all contacts, frame by frame."""
    return [
        (event.frame, [(c.id, c.phase, c.x_mm, c.y_mm, c.sigma_mm, c.confidence, c.force) for c in event.contacts])
        for event in touches
    ]


def pieces(recording: Recording, block: int) -> Iterator[Frame]:
    """The frames of a recording, each from a buffer that is overwritten after some: as live sources do."""
    buffer = np.zeros((block, *recording.frames.shape[1:]), np.int16)
    for i, frame in enumerate(frames_of(recording)):
        if i % block == 0:
            part = recording.frames[i : i + block]
            buffer[:] = -1
            buffer[: len(part)] = part
        yield structs.replace(frame, counts=buffer[i % block])


def _events(source: Source) -> Contacts:
    return contacts_of(run_through(source, Settings(), shipped(atlas=True)).touches)


def chunked(recording: Recording, folder: Path, sizes: Sequence[int]) -> Iterator[tuple[str, Contacts]]:
    """The contacts of a recording that lies in files, and comes from a source, in pieces of these sizes."""
    for size in sizes:
        parts = folder / f"chunks-{size}"
        parts.mkdir()
        for number, start in enumerate(range(0, len(recording.frames), size)):
            write(parts / f"{number:05d}.npz", _part(recording, start, start + size), compress=False)
        frames = f"{size} frame{'s'[: size > 1]}"
        yield f"files of {frames}", _events(ReplaySource(parts, speed=float("inf")))
        yield f"blocks of {frames}", _events(Given(recording.acquisition, pieces(recording, size)))


def whole(recording: Recording, folder: Path) -> Contacts:
    """The contacts of a recording in one file."""
    path = folder / "whole.npz"
    write(path, recording, compress=False)
    return _events(ReplaySource(path, speed=float("inf")))


def _part(recording: Recording, start: int, stop: int) -> Recording:
    r, cut = recording, slice(start, stop)
    return Recording(r.meta, r.frames[cut], r.sequence[cut], r.timestamp_ns[cut])


def with_blas_threads(path: Path, threads: int) -> Contacts:
    """The contacts of a recording, from a process whose linear algebra may use so many threads."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    environment = os.environ | dict.fromkeys(names, str(threads))
    command = [sys.executable, "-m", "tests.scenes.numerics.independence", str(path)]
    done = subprocess.run(command, env=environment, capture_output=True, check=True, text=True, timeout=120)
    return [(frame, [tuple(contact) for contact in contacts]) for frame, contacts in json.loads(done.stdout)]


def farthest_mm(one: Contacts, other: Contacts) -> float:
    """The largest distance of two runs' contacts; infinite if not the same ones do the same in the same frames."""

    def names(run: Contacts) -> list[tuple[int, list[tuple[float | str, ...]]]]:
        return [(frame, [contact[:2] for contact in contacts]) for frame, contacts in run]

    if names(one) != names(other):
        return float("inf")
    places = [
        np.array([contact[2:4] for _, contacts in run for contact in contacts], float).reshape(-1, 2)
        for run in (one, other)
    ]
    return float(np.linalg.norm(places[0] - places[1], axis=1).max(initial=0.0))


if __name__ == "__main__":
    print(json.dumps(_events(ReplaySource(Path(sys.argv[1]), speed=float("inf")))))
