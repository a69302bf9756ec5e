"""Simulate the scenes that the daemon benchmark plays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from touchd.errors import SimulationError
from touchd.lab.benchmark.loop import Loop
from touchd.recording.data import Recording
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_scene

SEED = 211
RAMP_FRAMES = 10
"""Frames in which a finger comes down or lifts."""


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
LEARN_FRAMES = 60
"""Least number of untouched frames before the first touch, from which the baseline is learned."""


def make_loop(name: str, instrument: Instrument) -> Loop:
    """Simulate a scene of `WANTED`; the loop plays its longest run with all fingers down."""
    act, count, fingers = WANTED[name]
    recording = simulate_scene(act, seed=SEED, frames=count, instrument=instrument)
    first, last = _longest_run(recording, fingers)
    return Loop(recording.acquisition, recording.frames[:last], first)


def _longest_run(recording: Recording, fingers: int) -> tuple[int, int]:
    """Return first and end frame of the longest run with this number of settled fingers."""
    truth = recording.contacts_mm
    assert truth is not None  # the twin labels its scenes
    down = np.isfinite(truth[:, :, 0]).sum(axis=1) == fingers
    down[:LEARN_FRAMES] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[False], down, [False]]).astype(np.int8)))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        raise SimulationError(f"no {fingers} fingers are ever down together", "frames", "simulate more")
    first, last = runs[(runs[:, 1] - runs[:, 0]).argmax()].tolist()
    ramp = RAMP_FRAMES if fingers else 0
    return first + ramp, last - ramp
