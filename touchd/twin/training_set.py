"""The robot's session: touches all over the plate, each with an untouched frame just before it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.electronics import Electronics
from touchd.twin.finger import force_of, tissue_of
from touchd.twin.instrument import REFERENCE_C
from touchd.twin.stage import Stage

TOUCH_RATE_HZ = 2.0
"""A robot is slow."""
AREAS_MM2 = {"silicone": (12.0, 28.0), "human": (40.0, 100.0)}
"""Range of the contact area, which the force varies."""
MARGIN_MM = {"silicone": 5.0, "human": 6.0}
"""Least distance of a touch's centre from the plate's edge: the whole contact lies on the plate."""
WALK_K = 1.0
"""The temperature's walk over the session stays within +- this."""


def write_touches(
    count: int,
    plate: Plate,
    rng: np.random.Generator,
    electronics: Electronics,
    finger: str,
    margin_mm: float | None,
    stale_k: float,
) -> Stage:
    """Write down a session; see `touchd.twin.simulate.simulate_touches`."""
    tissue_of(finger)
    margin_mm = MARGIN_MM[finger] if margin_mm is None else margin_mm
    low, high = AREAS_MM2[finger]
    span = np.array([plate.width_mm, plate.height_mm]) - 2 * margin_mm
    if count < 1:
        raise SimulationError(f"{count} touches", "count", "ask for one at least")
    if margin_mm < np.sqrt(high / np.pi) or span.min() <= 0:
        raise SimulationError(
            f"a margin of {margin_mm:g} mm on a {plate.width_mm:g} x {plate.height_mm:g} mm plate",
            "margin",
            f"use {np.sqrt(high / np.pi):.1f} mm or more, and less than half of the plate",
        )
    walk = np.cumsum(rng.standard_normal(2 * count))
    walk *= WALK_K / np.abs(walk).max()
    walk[1::2] += stale_k
    stage = Stage(plate, TOUCH_RATE_HZ, np.arange(2 * count), REFERENCE_C + walk, rng, electronics)
    stage.notes = f"{count} simulated touches of a {finger} finger, each after an untouched frame"
    touched = np.arange(2 * count) % 2 == 1
    area = rng.uniform(low, high, count)
    place = margin_mm + span * rng.uniform(size=(count, 2))

    def row(value: NDArray[np.float64]) -> NDArray[np.float64]:
        filled = np.full(2 * count, np.nan)
        filled[touched] = value
        return filled

    stage.kinds.append(finger)
    stage.columns.append([0])
    stage.x_mm.append(row(place[:, 0]))
    stage.y_mm.append(row(place[:, 1]))
    stage.area_mm2.append(row(area))
    stage.force_n.append(row(force_of(finger, area)))
    return stage
