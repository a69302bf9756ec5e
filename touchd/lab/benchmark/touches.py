"""Simulate the touches for all estimators, with a seed unseen in training."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import residual_of
from touchd.recording.data import Recording
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import force_of
from touchd.twin.scenes.robot import AREAS_MM2, MARGIN_MM
from touchd.twin.scenes.timeline import Stage
from touchd.twin.simulate import recording_of, stream

SEED = 210
FINGER = "silicone"
BLOCK = 20
"""Touches at one temperature, with one baseline."""
UNTOUCHED = 16
"""Frames averaged for the baseline of a block; the daemon averages more."""
STEP_MM = 0.8
"""Distance from the finger's position one frame before: 100 mm/s at 125 frames/s."""
WALK_K = 1.0
RATE_HZ = 125.0

Array = NDArray[np.float32]


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

    @property
    def count(self) -> int:
        """Number of touches."""
        return len(self.blocks) * BLOCK


def held_out(count: int, instrument: Instrument, seed: int = SEED) -> HeldOut:
    """Simulate `count` touches, a multiple of `BLOCK`, anywhere on the plate except its margin."""
    stage = _stage(count // BLOCK, instrument, seed)
    frames = np.concatenate(list(stream(stage, instrument, seed)))
    whole = recording_of(stage, instrument, frames)
    size = UNTOUCHED + 2 * BLOCK
    assert whole.contacts_mm is not None
    blocks = list(_blocks(frames, whole.contacts_mm[:, 0], size))
    kept = np.arange(len(frames)) % size
    kept = (kept < UNTOUCHED) | ((kept - UNTOUCHED) % 2 == 1)
    recording = Recording(
        meta=whole.meta, frames=frames[kept], sequence=whole.sequence[kept], timestamp_ns=whole.timestamp_ns[kept],
        contacts_mm=whole.contacts_mm[kept],
    )  # fmt: skip
    return HeldOut(blocks, recording)


def _blocks(frames: NDArray[np.int16], true_mm: Array, size: int) -> Iterator[Block]:
    for start in range(0, len(frames), size):
        untouched, touched = frames[start : start + UNTOUCHED], slice(start + UNTOUCHED, start + size)
        baseline = untouched.mean(axis=0, dtype=np.float32)
        residual = residual_of(frames[touched], baseline)
        yield Block(
            baseline, residual_of(untouched, baseline), residual[0::2].copy(), residual[1::2].copy(),
            true_mm[touched][1::2],
        )  # fmt: skip


def _stage(blocks: int, instrument: Instrument, seed: int) -> Stage:
    """Write the stage: each block has untouched frames first, then touches."""
    rng = np.random.default_rng([seed, 0xBE7C])
    size = UNTOUCHED + 2 * BLOCK
    walk_k = np.cumsum(rng.standard_normal(blocks))
    walk_k *= WALK_K / max(np.abs(walk_k).max(), 1e-9)
    count, plate = blocks * BLOCK, instrument.plate
    temperature_c = REFERENCE_C + np.repeat(walk_k, size)
    stage = Stage(plate, RATE_HZ, np.arange(blocks * size), temperature_c, rng, Electronics())
    low_mm = MARGIN_MM[FINGER]
    high_mm = np.array([plate.width_mm, plate.height_mm]) - low_mm
    place_mm = rng.uniform(low_mm, high_mm, (count, 2))
    angle = rng.uniform(0, 2 * np.pi, count)
    before_mm = np.clip(place_mm + STEP_MM * np.stack([np.cos(angle), np.sin(angle)], axis=1), low_mm, high_mm)
    touched = np.arange(blocks * size) % size >= UNTOUCHED

    def row(values: NDArray[np.float64]) -> NDArray[np.float64]:
        filled = np.full(blocks * size, np.nan)
        filled[touched] = values
        return filled

    area_mm2 = np.repeat(rng.uniform(*AREAS_MM2[FINGER], count), 2)
    both_mm = np.stack([before_mm, place_mm], axis=1).reshape(-1, 2)
    stage.kinds.append(FINGER)
    stage.columns.append([0])
    stage.x_mm.append(row(both_mm[:, 0]))
    stage.y_mm.append(row(both_mm[:, 1]))
    stage.area_mm2.append(row(area_mm2))
    stage.force_n.append(row(np.asarray(force_of(FINGER, area_mm2), float)))
    return stage
