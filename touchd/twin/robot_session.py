"""Simulate a robot's session in parts, in parallel; the recording does not depend on the division, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.frame import ACQUISITIONS, Acquisition, Plate
from touchd.jobs import Job, run
from touchd.recording.data import Recording
from touchd.twin.electronics import noise_states
from touchd.twin.instrument import Instrument
from touchd.twin.rig import IDEAL, Rig
from touchd.twin.scenes.robot import TouchSet, stage_touches
from touchd.twin.scenes.timeline import Stage
from touchd.twin.simulate import BLOCK, no_frames, recording_of, stream

CHUNK = 16 * BLOCK
"""Frames per part, some tenths of a second's work; a multiple of `BLOCK`, so that sums round alike."""
FEW = 4 * CHUNK
"""Up to this number of frames, one process finishes before others would start."""


@dataclass(frozen=True)
class Session:
    """Everything that a session's frames depend on; see `touchd.twin.simulate.simulate_touches`."""

    touches: TouchSet
    seed: int
    plate: Plate
    loss: float
    tail_period_s: float | None
    rig: Rig = IDEAL
    acquisition: Acquisition = ACQUISITIONS["usb"]

    def prepare(self) -> tuple[Stage, Instrument]:
        """Write the session's timeline, and create its instrument; SimulationError if one is impossible."""
        instrument = self.rig.instrument(
            self.plate, loss=self.loss, tail_period_s=self.tail_period_s, acquisition=self.acquisition
        )
        return stage_touches(self.touches, self.plate, self.seed, self.rig.electronics), instrument


def simulate_session(
    session: Session,
    *,
    workers: int | None = None,
    dask: str | None = None,
    kept: Path | None = None,
    progress: Callable[[int], object] | None = None,
    chunk: int = CHUNK,
) -> Recording:
    """Simulate a session as `simulate_touches` does, on several processes or a cluster.

    Parameters
    ----------
    session : Session
    workers, dask
        See `touchd.jobs.run`; without both, few frames are computed in this process.
    kept : Path, optional
        Folder of finished parts; see `touchd.twin.cache.parts_kept`.
    progress : callable, optional
        Receives the number of frames just finished.
    chunk : int
        Frames per part, a multiple of `BLOCK`.

    Raises
    ------
    SimulationError
        Count, margin, finger or plate is impossible.
    JobError
    """
    stage, instrument = session.prepare()
    total = len(stage.sequence)
    starts = range(0, total, chunk)
    a = instrument.acquisition
    frames = no_frames(total, a)
    states = noise_states(session.seed, a.channels * a.samples, starts)
    places = {f"frames from {start}": slice(start, min(start + chunk, total)) for start in starts}
    jobs = [
        Job(name, part, {"session": session, "start": place.start, "stop": place.stop, "noise": noise})
        for (name, place), noise in zip(places.items(), states, strict=True)
    ]
    if workers is None and dask is None and total <= FEW:
        workers = 1

    def advance(name: str, _done: int, _total: int) -> None:
        if progress is not None:
            progress(places[name].stop - places[name].start)

    for name, counts in run(jobs, workers=workers, dask=dask, cache=kept, progress=advance).items():
        frames[places[name]] = counts
    return recording_of(stage, instrument, frames)


def part(session: Session, start: int, stop: int, noise: dict[str, Any]) -> NDArray[np.int16]:
    """Compute frames start .. stop - 1, as a job; `noise` is the state of the noise generator at `start`."""
    stage, instrument = _prepared(session)
    return np.concatenate(list(stream(stage, instrument, session.seed, start=start, stop=stop, noise=noise)))


@lru_cache(maxsize=1)
def _prepared(session: Session) -> tuple[Stage, Instrument]:
    """Prepare a session once per process."""
    return session.prepare()
