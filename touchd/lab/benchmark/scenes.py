"""Simulate what the benchmark measures: single touches for the estimators, scenes for the daemon."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import residual_of
from touchd.lab.benchmark.loop import Loop
from touchd.twin.electronics import Digitiser, Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.scenes.fingers import FORCES_N
from touchd.twin.scenes.robot import AREAS_MM2, MARGIN_MM
from touchd.twin.scenes.timeline import Stage, anywhere, line, still
from touchd.twin.simulate import DEFAULT_PLATE, simulate_scene, simulate_stage

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
LEARN_FRAMES = 60
"""Least number of untouched frames before a scene's first touch, from which the baseline is learned."""
RAMP_FRAMES = 10
"""Frames in which a finger comes down or lifts."""

DAY_S = 20.0
"""A day in little: taps, a finger that holds and one that moves, for 4 % of the time; else untouched."""
DAY = (("tap", 0.1), ("tap", 0.1), ("hold", 0.3), ("move", 0.3))
"""Its touches, one a second: what each is, and for how long, s."""

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
    contacts: list[Contact]
    """The touches."""

    @property
    def noise(self) -> Array:
        """Untouched residuals, scaled to the noise of frames that the baseline is not made of."""
        n = len(self.untouched)
        return self.untouched * np.float32(math.sqrt((n + 1) / (n - 1)))

    @property
    def true_mm(self) -> NDArray[np.float64]:
        """Positions of the touches, shape (BLOCK, 2)."""
        return np.array([contact[:2] for contact in self.contacts])


def held_out(count: int, instrument: Instrument) -> list[Block]:
    """Simulate `count` touches, a multiple of `BLOCK`, anywhere on the plate except its margin."""
    rng = np.random.default_rng([SEED, 0xBE7C])
    walk_k = np.cumsum(rng.standard_normal(count // BLOCK))
    walk_k *= WALK_K / max(np.abs(walk_k).max(), 1e-9)
    low_mm = MARGIN_MM[FINGER]
    high_mm = np.array(instrument.plate.size_mm) - low_mm
    place_mm = rng.uniform(low_mm, high_mm, (count, 2))
    angle = rng.uniform(0, 2 * np.pi, count)
    before_mm = np.clip(place_mm + STEP_MM * np.stack([np.cos(angle), np.sin(angle)], axis=1), low_mm, high_mm)
    area_mm2 = rng.uniform(*AREAS_MM2[FINGER], count).tolist()
    before, last = (
        [Contact(x, y, area, FINGER) for (x, y), area in zip(places.tolist(), area_mm2, strict=True)]
        for places in (before_mm, place_mm)
    )
    reference = instrument.untouched([REFERENCE_C])[0]
    digitiser = Digitiser(Electronics(), instrument.acquisition, reference, np.random.SeedSequence(SEED))
    blocks = []
    for start, warmer_k in zip(range(0, count, BLOCK), walk_k, strict=True):
        part = slice(start, start + BLOCK)
        at_c = np.full(UNTOUCHED + 2 * BLOCK, REFERENCE_C + warmer_k)
        signal = instrument.untouched(at_c)
        signal[UNTOUCHED:] += instrument.change([[touch] for touch in (*before[part], *last[part])], at_c[UNTOUCHED:])
        counts = digitiser.counts(signal, np.zeros(len(at_c)))
        baseline = counts[:UNTOUCHED].mean(axis=0, dtype=np.float32)
        untouched, preceding, touched = np.split(residual_of(counts, baseline), [UNTOUCHED, UNTOUCHED + BLOCK])
        blocks.append(Block(baseline, untouched, preceding, touched, last[part]))
    return blocks


def make_loop(name: str, instrument: Instrument) -> Loop:
    """Simulate a scene of `WANTED`; the loop plays its longest run with all fingers down and settled."""
    act, count, fingers = WANTED[name]
    recording = simulate_scene(act, seed=SCENE_SEED, frames=count, instrument=instrument)
    assert recording.contacts_mm is not None  # the twin labels its scenes
    down = np.isfinite(recording.contacts_mm[:, :, 0]).sum(axis=1) == fingers
    down[:LEARN_FRAMES] = False
    runs = np.flatnonzero(np.diff(np.concatenate([[False], down, [False]]).astype(np.int8))).reshape(-1, 2)
    first, last = runs[(runs[:, 1] - runs[:, 0]).argmax()].tolist()
    ramp = RAMP_FRAMES if fingers else 0
    return Loop(recording.acquisition, recording.frames[: last - ramp], first + ramp)


def make_day(instrument: Instrument) -> Loop:
    """Simulate `DAY_S` of a typical day at 125 frames/s, which begins and ends untouched."""
    rng, rate_hz = np.random.default_rng(SCENE_SEED), 125.0
    sequence = np.arange(LEARN_FRAMES + round(DAY_S * rate_hz))
    stage = Stage(DEFAULT_PLATE, rate_hz, sequence, np.full(len(sequence), REFERENCE_C), rng, Electronics())
    for second, (what, seconds) in enumerate(DAY, start=2):
        start, stop = anywhere(stage), anywhere(stage)
        path = line(start, stop, seconds) if what == "move" else still(*start)
        stage.lay("fingertip", second, second + seconds, path, force_n=rng.uniform(*FORCES_N["fingertip"]))
    recording = simulate_stage(stage, instrument, SCENE_SEED)
    return Loop(recording.acquisition, recording.frames, LEARN_FRAMES)
