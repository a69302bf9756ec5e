"""Recordings of the experiments: simulated with their own seeds, or cut from a given one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from touchd.errors import TrainingError
from touchd.evaluation.dataset import labels
from touchd.frame import Plate
from touchd.lab.reproduction.paper import CENTRAL_MM
from touchd.recording.data import Recording
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import Instrument
from touchd.twin.physics.transducer import Layout as Transducers
from touchd.twin.simulate import DEFAULT_PLATE, simulate_scene, simulate_touches

KINDS: dict[str, dict[str, Any]] = {
    "silicone": {},
    "human": {"finger": "human"},
    "central": {"margin_mm": (DEFAULT_PLATE.width_mm - CENTRAL_MM) / 2},
    "noise": {"electronics": Electronics(noise_db=40.0)},
    "stale": {"stale_k": 1.0},
}
"""Options of `simulate_touches` by kind: noise is 20 dB stronger than the reference, a stale baseline 1 K too cold."""
OTHER_PLATE = Plate(width_mm=170, height_mm=240, thickness_mm=4, material="glass")
OTHER_TRANSDUCERS = Transducers(
    emitter_mm=(90.0, 18.0), receivers_mm=((14.0, 60.0), (152.0, 40.0), (25.0, 222.0), (158.0, 205.0))
)
"""A plate for which no shipped model and no constant in the code was tuned."""


def simulated(kind: str, count: int, seed: int) -> Recording:
    """Simulate touches of one of `KINDS`, or of the `other` plate; or the `circle` that a human finger draws."""
    if kind == "circle":
        return simulate_scene("circle", seed=seed, finger="human", frames=count)
    if kind == "other":
        return simulate_touches(count, seed=seed, instrument=Instrument(OTHER_PLATE, layout=OTHER_TRANSDUCERS))
    return simulate_touches(count, seed=seed, **KINDS[kind])


def check_touches(recording: Recording, where: str) -> None:
    """Raise TrainingError if a recording has too few touches, on its whole plate or on the central square."""
    for part, place in ((recording, ""), (central(recording, CENTRAL_MM), f" on the central {CENTRAL_MM:g} mm")):
        try:
            labels(part)
        except TrainingError as error:
            raise TrainingError(f"{error.what}{place}", where, error.fix) from error


def central(recording: Recording, side_mm: float) -> Recording:
    """Cut the central square out of a recording, as if it were the whole plate.

    Positions are relative to the square's corner. Frames with touches outside are dropped.
    """
    plate, truth = recording.meta.plate, recording.contacts_mm
    assert truth is not None  # checked by the caller
    low_mm = (np.array(plate.size_mm) - side_mm) / 2
    place_mm = truth - low_mm
    down = np.isfinite(place_mm[:, :, 0])
    outside = down & ((place_mm < 0) | (place_mm > side_mm)).any(axis=2)
    keep = ~outside.any(axis=1)
    meta = recording.meta.model_copy(
        update={"plate": plate.model_copy(update={"width_mm": side_mm, "height_mm": side_mm})}
    )
    return replace(
        recording, meta=meta, frames=recording.frames[keep], sequence=recording.sequence[keep],
        timestamp_ns=recording.timestamp_ns[keep], contacts_mm=place_mm[keep].astype(np.float32), force_n=None,
        temperature_c=None,
    )  # fmt: skip
