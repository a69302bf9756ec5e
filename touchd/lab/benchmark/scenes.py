"""Simulate what the benchmark measures: single touches for the estimators, scenes for the daemon."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.evaluation.dataset import residual_of
from touchd.lab.benchmark.loop import Loop
from touchd.recording.data import Recording
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import force_of
from touchd.twin.scenes.robot import AREAS_MM2, MARGIN_MM
from touchd.twin.scenes.timeline import Stage
from touchd.twin.simulate import recording_of, simulate_scene, stream

SEED, SCENE_SEED = 210, 211
"""Unseen in training."""
FINGER = "silicone"
BLOCK = 20
"""Touches at one temperature, with one baseline."""
UNTOUCHED = 16
"""Frames averaged for the baseline of a block; the daemon averages more."""
STEP_MM = 0.8
"""Distance from the finger's position one frame before: 100 mm/s at 125 frames/s."""
WALK_K = 1.0
RATE_HZ = 125.0
LEARN_FRAMES = 60
"""Least number of untouched frames before a scene's first touch, from which the baseline is learned."""
RAMP_FRAMES = 10
"""Frames in which a finger comes down or lifts."""

Array = NDArray[np.float32]


class _Wanted(NamedTuple):
    act: str
    """The scene of `touchd.twin.scenes.catalogue`."""
    frames: int
    fingers: int


WANTED = {
    "idle": _Wanted("idle", 300, 0),
    "still": _Wanted("hold", 450, 1),
    "moving": _Wanted("circle", 450, 1),
    "two fingers": _Wanted("two", 500, 2),
    "keypad": _Wanted("keypad", 500, 1),
}


class Block(NamedTuple):
    """Touches at one temperature."""

    baseline: Array
    """Mean untouched frame, shape (channels, samples), ADC counts."""
    untouched: Array
    """Residuals of the untouched frames, shape (UNTOUCHED, channels, samples)."""
    before: Array
    """Residuals of the preceding frames, with each finger `STEP_MM` away, shape (BLOCK, channels, samples)."""
    residual: Array
    """Residuals of the touches, shape (BLOCK, channels, samples)."""
    true_mm: Array
    """True positions, shape (BLOCK, 2)."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """All blocks, and their recording."""

    blocks: list[Block]
    recording: Recording
    """Untouched and touched frames, without the preceding ones."""


def held_out(count: int, instrument: Instrument) -> HeldOut:
    """Simulate `count` touches, a multiple of `BLOCK`, anywhere on the plate except its margin."""
    blocks, size = count // BLOCK, UNTOUCHED + 2 * BLOCK
    number = np.arange(blocks * size)
    stage = _stage(number, count, instrument)
    whole = recording_of(stage, instrument, np.concatenate(list(stream(stage, instrument, SEED))))
    assert whole.contacts_mm is not None
    made = []
    for start in range(0, len(number), size):
        untouched, touched = whole.frames[start : start + UNTOUCHED], slice(start + UNTOUCHED, start + size)
        baseline = untouched.mean(axis=0, dtype=np.float32)
        residual = residual_of(whole.frames[touched], baseline)
        true_mm = whole.contacts_mm[touched, 0][1::2]
        before, last = residual[0::2].copy(), residual[1::2].copy()
        made.append(Block(baseline, residual_of(untouched, baseline), before, last, true_mm))
    kept = (number % size < UNTOUCHED) | ((number % size - UNTOUCHED) % 2 == 1)
    recording = Recording(
        meta=whole.meta, frames=whole.frames[kept], sequence=whole.sequence[kept],
        timestamp_ns=whole.timestamp_ns[kept], contacts_mm=whole.contacts_mm[kept],
    )  # fmt: skip
    return HeldOut(made, recording)


def _stage(number: NDArray[np.int64], count: int, instrument: Instrument) -> Stage:
    """Write the timeline: each block has untouched frames first, then touches."""
    rng = np.random.default_rng([SEED, 0xBE7C])
    size, plate = UNTOUCHED + 2 * BLOCK, instrument.plate
    walk_k = np.cumsum(rng.standard_normal(count // BLOCK))
    walk_k *= WALK_K / max(np.abs(walk_k).max(), 1e-9)
    stage = Stage(plate, RATE_HZ, number, REFERENCE_C + np.repeat(walk_k, size), rng, Electronics())
    low_mm = MARGIN_MM[FINGER]
    high_mm = np.array([plate.width_mm, plate.height_mm]) - low_mm
    place_mm = rng.uniform(low_mm, high_mm, (count, 2))
    angle = rng.uniform(0, 2 * np.pi, count)
    before_mm = np.clip(place_mm + STEP_MM * np.stack([np.cos(angle), np.sin(angle)], axis=1), low_mm, high_mm)
    both_mm = np.stack([before_mm, place_mm], axis=1).reshape(-1, 2)
    area_mm2 = np.repeat(rng.uniform(*AREAS_MM2[FINGER], count), 2)
    force_n = np.asarray(force_of(FINGER, area_mm2))
    stage.kinds.append(FINGER)
    stage.columns.append([0])
    for rows, values in (
        (stage.x_mm, both_mm[:, 0]), (stage.y_mm, both_mm[:, 1]), (stage.area_mm2, area_mm2), (stage.force_n, force_n),
    ):  # fmt: skip
        row = np.full(len(number), np.nan)
        row[number % size >= UNTOUCHED] = values
        rows.append(row)
    return stage


def make_loop(name: str, instrument: Instrument) -> Loop:
    """Simulate a scene of `WANTED`; the loop plays its longest run with all fingers down and settled."""
    act, count, fingers = WANTED[name]
    recording = simulate_scene(act, seed=SCENE_SEED, frames=count, instrument=instrument)
    assert recording.contacts_mm is not None  # the twin labels its scenes
    down = np.isfinite(recording.contacts_mm[:, :, 0]).sum(axis=1) == fingers
    down[:LEARN_FRAMES] = False
    runs = np.flatnonzero(np.diff(np.concatenate([[False], down, [False]]).astype(np.int8))).reshape(-1, 2)
    if not len(runs):
        raise SimulationError(f"no {fingers} fingers are ever down together", "frames", "simulate more")
    first, last = runs[(runs[:, 1] - runs[:, 0]).argmax()].tolist()
    ramp = RAMP_FRAMES if fingers else 0
    return Loop(recording.acquisition, recording.frames[: last - ramp], first + ramp)
