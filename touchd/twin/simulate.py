"""Simulate a scene: at once as a recording, block by block for a live source, or a robot's session in parallel."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import ACQUISITIONS, Acquisition, Plate
from touchd.jobs import Job, run
from touchd.recording.data import Device, Meta, Recording
from touchd.twin.electronics import Digitiser, Electronics, noise_states, rippled
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.body import Coupled
from touchd.twin.physics.film import Wetted
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.friction import Friction
from touchd.twin.physics.knock import Ringing
from touchd.twin.physics.other_pane import Heard
from touchd.twin.rig import IDEAL, Rig
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.scenes.robot import COUNT, TouchSet, stage_touches
from touchd.twin.scenes.timeline import Stage

Floats = NDArray[np.float64]
Progress = Callable[[int], object]
"""Receives the number of frames just finished."""

BLOCK = 64
"""Frames per block, counted from the scene's first frame, so that results do not depend on the caller."""
CHUNK = 16 * BLOCK
"""Frames per part, some tenths of a second's work; a multiple of `BLOCK`, so that sums round alike."""
FEW = 4 * CHUNK
"""Up to this number of frames, one process finishes before others would start."""

MOVES_MM, GROWS = 0.01, 0.02
"""Way of a contact during a frame, and change of its area, from which the frame differs from one of rest: 10 mm/s."""

DEFAULT_PLATE = Plate(width_mm=200, height_mm=200, thickness_mm=5, material="glass")


def stream(
    stage: Stage,
    instrument: Instrument,
    seed: int | Sequence[int],
    block: int = BLOCK,
    *,
    start: int = 0,
    stop: int | None = None,
    noise: Mapping[str, Any] | None = None,
) -> Iterator[NDArray[np.int16]]:
    """Yield a scene's frames in blocks, on demand: int16 arrays of shape (up to `block`, channels, samples).

    Frames `start` .. `stop` - 1 equal those of the whole; `start` is a multiple of `block`, and unless it is 0, `noise`
    is the state of the noise there, from `touchd.twin.electronics.noise_states`.
    """
    jitter_seed, digitiser_seed = np.random.SeedSequence(seed).spawn(3)[1:]  # each with its own generator
    jitter = np.random.default_rng(jitter_seed)
    reference = instrument.untouched([REFERENCE_C])[0]
    digitiser = Digitiser(stage.electronics, instrument.acquisition, reference, digitiser_seed, noise)
    jitter.standard_normal(start)  # skip the jitter of earlier frames
    time_s, a = stage.time_s, instrument.acquisition
    ringings = [Ringing(instrument, knock) for knock in stage.knocks]
    rubs = [Friction(instrument, rub, [*np.atleast_1d(seed), k]) for k, rub in enumerate(stage.rubs)]
    beside: list[Heard | Wetted | Coupled] = [Heard(instrument, pane, stage.rate_hz) for pane in stage.other_panes]
    for k, film in enumerate(stage.films, len(rubs)):
        beside.append(Wetted(instrument, film, [*np.atleast_1d(seed), k]))
    for k, body in enumerate(stage.bodies, len(rubs) + len(stage.films)):
        beside.append(Coupled(instrument, body, [*np.atleast_1d(seed), k]))
    # In steady state a frame is the mean of all chirps up to the next one.
    starts_s = np.arange(max(round(1 / (stage.rate_hz * (a.chirp.period_s or np.inf))), 1)) * (a.chirp.period_s or 0.0)
    sample_s = starts_s[:, None] + np.arange(a.samples) / a.sample_rate_hz
    end = len(time_s) if stop is None else stop
    for first in range(start, end, block):
        last = min(first + block, end)
        late_s = stage.electronics.jitter_s * jitter.standard_normal(last - first)
        temperature_c = stage.temperature_c[first:last]
        signal = instrument.untouched(temperature_c, late_s)
        touches = stage.touches(first, last)
        if any(touches):
            signal += change_by(stage, instrument, first, touches, temperature_c, late_s)
        if stage.electronics.ripple is not None:
            signal = rippled(signal, time_s[first:last], starts_s, a, stage.electronics.ripple, seed)
        for ringing in ringings:
            for frame, begin_s in zip(signal, time_s[first:last].tolist(), strict=True):
                if begin_s + sample_s[-1, -1] > ringing.at_s:
                    frame += sum(ringing.signal(begin_s + each_s) for each_s in sample_s) / len(sample_s)
        for rub in rubs:
            for frame, begin_s in zip(signal, time_s[first:last].tolist(), strict=True):
                frame += np.mean([rub.signal(begin_s + chirp_s) for chirp_s in starts_s.tolist()], axis=0)
        for other in beside:
            for frame, begin_s in zip(signal, time_s[first:last].tolist(), strict=True):
                frame += other.signal(begin_s)
        yield digitiser.counts(signal, time_s[first:last], np.array([bool(touch) for touch in touches]))


def change_by(
    stage: Stage, instrument: Instrument, start: int, touches: Sequence[list[Contact]], temperature_c: Floats,
    late_s: Floats,
) -> Floats:  # fmt: skip
    """Return the change by a stage's `touches` of n frames from `start` on, shape (n, channels, samples).

    They move during a frame. A plate answers at once, relative to a hand: at 1 m/s a contact goes a millimetre in a
    frame, a wave a metre and more. So the change goes over from that of the frame's first moment to that of its last.
    At 0.5 m/s that misses a thousandth of the change, contacts at rest a twenty-fifth.
    """
    a, stop = instrument.acquisition, start + len(touches)
    half_s = a.samples / a.sample_rate_hz / 2
    first, last = (stage.touches(start, stop, off_s) for off_s in (-half_s, half_s))
    moved = np.array([any(map(_moved, *pair)) for pair in zip(first, last, strict=True)])
    begin = [early if moves else middle for early, middle, moves in zip(first, touches, moved, strict=True)]
    change = instrument.change(begin, temperature_c, late_s)
    if moved.any():
        at = np.flatnonzero(moved)
        end = instrument.change([last[i] for i in at], temperature_c[at], late_s[at])
        change[at] += np.linspace(0, 1, a.samples) * (end - change[at])
    return change


def _moved(first: Contact, last: Contact) -> bool:
    """Return whether a contact moves or grows during a frame by more than a plate shows."""
    way_mm = math.hypot(last.x_mm - first.x_mm, last.y_mm - first.y_mm)
    return way_mm > MOVES_MM or abs(last.area_mm2 / first.area_mm2 - 1) > GROWS


def simulate_scene(
    name: str,
    *,
    seed: int = 0,
    frames: int | None = None,
    instrument: Instrument | None = None,
    electronics: Electronics | None = None,
    finger: str | None = None,
) -> Recording:
    """Simulate a named scene; `frames`, `electronics` and `finger` are as for `stage_scene`.

    Equal seeds give equal recordings, bit for bit. Raises SimulationError if the scene is unknown, too short, or does
    not fit the plate.
    """
    instrument = instrument or Instrument(DEFAULT_PLATE)
    stage = stage_scene(name, instrument.plate, seed=seed, frames=frames, electronics=electronics, finger=finger)
    return simulate_stage(stage, instrument, seed)


def simulate_touches(
    count: int = COUNT,
    *,
    seed: int = 0,
    instrument: Instrument | None = None,
    electronics: Electronics | None = None,
    **asked: Any,
) -> Recording:
    """Simulate a robot's training set of `count` touches: untouched frame, touch, untouched frame, touch, ...

    `asked` are fields of `TouchSet`; the others are as for `simulate_scene`. Raises SimulationError if count, margin,
    finger or distances are impossible.
    """
    instrument = instrument or Instrument(DEFAULT_PLATE)
    stage = stage_touches(TouchSet(count, **asked), instrument.plate, seed, electronics)
    return simulate_stage(stage, instrument, seed)


def meta_of(instrument: Instrument, rate_hz: float, notes: str) -> Meta:
    """Return the metadata of simulated frames."""
    a, layout = instrument.acquisition, instrument.layout
    return Meta(
        sample_rate_hz=a.sample_rate_hz, bits=a.bits, full_scale_v=a.full_scale_v, frame_rate_hz=rate_hz,
        plate=instrument.plate, chirp=a.chirp, emitter_mm=layout.emitter_mm, receivers_mm=layout.receivers_mm,
        source="simulated", device=Device(serial="twin", firmware=""),
        created=datetime.now(UTC).isoformat(timespec="seconds"), notes=notes,
    )  # fmt: skip


def simulate_stage(stage: Stage, instrument: Instrument, seed: int, progress: Progress | None = None) -> Recording:
    """Simulate all frames of a scene."""
    frames = no_frames(len(stage.sequence), instrument.acquisition)
    done = 0
    for block in stream(stage, instrument, seed):
        frames[done : done + len(block)] = block
        done += len(block)
        if progress is not None:
            progress(len(block))
    return recording_of(stage, instrument, frames)


def no_frames(count: int, acquisition: Acquisition) -> NDArray[np.int16]:
    """Reserve memory for frames, shape (count, channels, samples).

    Raises SimulationError if the memory is too small.
    """
    try:
        return np.empty((count, *acquisition.shape), dtype=np.int16)
    except MemoryError:
        raise SimulationError(f"{count} frames do not fit into memory", "frames", "simulate fewer at a time") from None


def recording_of(stage: Stage, instrument: Instrument, frames: NDArray[np.int16]) -> Recording:
    """Combine a scene's frames, of shape (n, channels, samples), with its labels."""
    contacts_mm, force_n = stage.truth()
    return Recording(
        meta=meta_of(instrument, stage.rate_hz, stage.notes),
        frames=frames,
        sequence=stage.sequence.astype(np.int64),
        timestamp_ns=np.rint(stage.time_s * 1e9).astype(np.int64),
        contacts_mm=contacts_mm,
        force_n=force_n,
        faces=stage.faces(),
        temperature_c=stage.temperature_c.astype(np.float32),
    )


@dataclass(frozen=True)
class Session:
    """Everything that the frames of a robot's session depend on; see `simulate_touches`."""

    touches: TouchSet
    seed: int
    plate: Plate
    loss: float
    rig: Rig = IDEAL
    acquisition: Acquisition = ACQUISITIONS["usb"]


@lru_cache(maxsize=1)
def _prepared(session: Session) -> tuple[Stage, Instrument]:
    """Write a session's timeline, and create its instrument, once per process; SimulationError if one is impossible."""
    s = session
    instrument = s.rig.instrument(s.plate, loss=s.loss, acquisition=s.acquisition)
    return stage_touches(s.touches, s.plate, s.seed, s.rig.electronics), instrument


def simulate_session(
    session: Session,
    *,
    workers: int | None = None,
    dask: str | None = None,
    kept: Path | None = None,
    progress: Progress | None = None,
    chunk: int = CHUNK,
) -> Recording:
    """Simulate a session as `simulate_touches` does, to the bit, on several processes or a cluster.

    For `workers` and `dask` see `touchd.jobs.run`; without both, few frames are computed in this process. `kept` is the
    folder of finished parts, see `touchd.twin.cache.parts_kept`; `chunk` the frames of each, a multiple of `BLOCK`.
    Raises SimulationError if count, margin, finger or plate is impossible; JobError if a part fails.
    """
    stage, instrument = _prepared(session)
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
