"""Simulate a scene: at once as a recording, or block by block for a live source."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Acquisition, Plate
from touchd.recording.data import Device, Meta, Recording
from touchd.twin.electronics import Digitiser, Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.scenes.robot import COUNT, TouchSet, stage_touches
from touchd.twin.scenes.timeline import Stage

Floats = NDArray[np.float64]
Progress = Callable[[int], object]
"""Receives the number of frames just finished."""

BLOCK = 64
"""Frames per block, counted from the scene's first frame, so that results do not depend on the caller."""

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
    digitiser = Digitiser(stage.electronics, instrument.acquisition, reference, digitiser_seed)
    if noise is not None:
        digitiser.resume(noise)
    jitter.standard_normal(start)  # skip the jitter of earlier frames
    time_s = stage.time_s
    end = len(time_s) if stop is None else stop
    for first in range(start, end, block):
        last = min(first + block, end)
        late_s = stage.electronics.jitter_s * jitter.standard_normal(last - first)
        temperature_c = stage.temperature_c[first:last]
        signal = instrument.untouched(temperature_c, late_s)
        touches = stage.touches(first, last)
        if any(touches):
            signal += change_by(stage, instrument, first, touches, temperature_c, late_s)
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
    """Simulate a named scene.

    Parameters
    ----------
    name, frames, electronics, finger
        See `touchd.twin.scenes.catalogue.stage_scene`.
    seed : int
        Equal seeds give equal recordings, bit for bit.
    instrument : Instrument, optional
        By default that of the default plate.

    Raises
    ------
    SimulationError
        The scene is unknown, too short, or does not fit the plate.
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
    finger: str = "silicone",
    margin_mm: float | None = None,
    stale_k: float = 0.0,
    fingers: int = 1,
    apart_mm: float = 0.0,
    warmer_k: float = 0.0,
    label_noise_mm: float = 0.0,
    even: bool = False,
) -> Recording:
    """Simulate a robot's training set: untouched frame, touch, untouched frame, touch, ...

    Parameters
    ----------
    count : int
        Number of touches; the recording has twice as many frames.
    seed : int
        Equal seeds give equal recordings, bit for bit.
    instrument, electronics
        As for `simulate_scene`.
    finger : a kind of `touchd.twin.physics.finger.TISSUES`
        Areas and ratios of the axes are drawn from `touchd.twin.scenes.robot.AREAS_MM2` and `timeline.RATIOS`.
    margin_mm : float, optional
        Least distance of a touch's centre from the edge; by default such that the contact fits.
    stale_k : float
        Warming of the plate between an untouched frame and the touch after it, K.
    fingers : int
        Contacts of each touch, 1 .. 5, each with its own area, without overlap.
    apart_mm : float
        Least distance between centres.
    warmer_k : float
        Temperature of the session above the reference, K; may be negative.
    label_noise_mm : float
        Standard deviation of the labels per axis.
    even : bool
        Leave no gaps, and touch up to the edges; else places are drawn at random.

    Raises
    ------
    SimulationError
        Count, margin, finger or distances are impossible.
    """
    asked = TouchSet(count, finger, margin_mm, stale_k, fingers, apart_mm, None, warmer_k, label_noise_mm, even)
    instrument = instrument or Instrument(DEFAULT_PLATE)
    return simulate_stage(stage_touches(asked, instrument.plate, seed, electronics), instrument, seed)


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

    Raises
    ------
    SimulationError
        The memory is too small.
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
