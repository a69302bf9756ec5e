"""Trajectories of a finger: each maps seconds since landing, shape (m,), to x and y in mm."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.twin.scenes.timeline import Path, Stage

Floats = NDArray[np.float64]


def still(x_mm: float, y_mm: float) -> Path:
    """Stay at a position."""
    return lambda t: (np.full(len(t), x_mm), np.full(len(t), y_mm))


def line(start: ArrayLike, stop: ArrayLike, seconds: float) -> Path:
    """Move between two positions, with zero speed at both ends."""
    a, b = np.asarray(start, dtype=float), np.asarray(stop, dtype=float)

    def path(t: Floats) -> tuple[ArrayLike, ArrayLike]:
        part = 0.5 - 0.5 * np.cos(np.pi * np.clip(t / seconds, 0, 1))
        return a[0] + (b[0] - a[0]) * part, a[1] + (b[1] - a[1]) * part

    return path


def arc(stage: Stage, seconds: float, turns: float) -> Path:
    """Draw a circle around the centre, clockwise from the top; radius 60 mm, less on a small plate."""
    cx, cy = stage.plate.width_mm / 2, stage.plate.height_mm / 2
    radius = min(60.0, cx - 15, cy - 15)

    def path(t: Floats) -> tuple[ArrayLike, ArrayLike]:
        angle = 2 * np.pi * turns * np.clip(t / seconds, 0, 1)
        return cx + radius * np.sin(angle), cy - radius * np.cos(angle)

    return path


def anywhere(stage: Stage, margin_mm: float = 12.0) -> tuple[float, float]:
    """Return a random position, x and y in mm, at least `margin_mm` from the edge."""
    x, y = stage.rng.uniform(size=2)
    p = stage.plate
    return margin_mm + x * (p.width_mm - 2 * margin_mm), margin_mm + y * (p.height_mm - 2 * margin_mm)
