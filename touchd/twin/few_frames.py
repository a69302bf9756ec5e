"""Frames of contacts that change smoothly in time: few are computed, and the others follow from them.

A finger at rest pulses, turns and grows from frame to frame, by little. What the plate hears is a smooth function of
where and how large its contacts are; so if these follow from a few frames by polynomials in time, the signals do.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.twin.physics import chebyshev
from touchd.twin.physics.finger import Contact

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

COUNTS = (4, 6, 8, 12, 16, 24)
"""Frames that may tell a run of at least twice as many."""
WAVE_MM, FAST_MM = 8.0, 1.0
"""Shorter than any wave and disc: what waves of this length tell of a way, signals do. A contact that goes farther from
one frame to the next is computed in each: after a whole wave it would look as if it rested."""
TOLERANCE = 1e-6
"""Of the logarithm of areas, of ratios, angles, and waves along a way; signals then err by as much of a finger's."""
SCALE_TOLERANCE = 1e-10
"""Of the modes' frequencies: a signal of some milliseconds has hundreds of turns."""


class Few(NamedTuple):
    """Which of n successive frames to compute."""

    rows: list[int]
    runs: list[tuple[int, Floats | None]]
    """How many frames of each run are computed, and their weights in all of its frames, unless these are all."""

    def spread(self, computed: Complex) -> Complex:
        """Return all frames' values, (n, ...), by those computed, (m, ...)."""
        found, start = [], 0
        for count, weights in self.runs:
            some = computed[start : start + count]
            found.append(np.tensordot(weights, some, 1) if weights is not None else some)
            start += count
        return np.concatenate(found)


def few_of(touches: Sequence[Sequence[Contact]], scale: Floats) -> Few:
    """Choose those of n successive frames, of contacts of the same kinds, that tell all others.

    `scale`, (n,), is the factor of all modes' frequencies.
    """
    numbers = np.array([[each for one in touch for each in (*one[:3], *one[4:])] for touch in touches])
    x, y, area_mm2, ratio, angle_rad = np.moveaxis(numbers.reshape(len(touches), -1, 5), 2, 0)
    places_mm = np.concatenate([x, y], axis=1)
    along = 2 * np.pi / WAVE_MM * places_mm
    scales = scale[:, None] * (TOLERANCE / SCALE_TOLERANCE)
    told = np.concatenate([np.cos(along), np.sin(along), np.log(area_mm2), ratio, angle_rad, scales], axis=1)
    few = Few([], [])
    _choose(told / TOLERANCE, np.abs(np.diff(places_mm, axis=0)).max(axis=1) > FAST_MM, 0, few)
    return few


def _choose(told: Floats, fast: NDArray[np.bool_], first: int, few: Few) -> None:
    """Add a run from frame `first` on, or its halves if no few frames tell it; `fast` are its steps."""
    frames = len(told)
    for count in () if fast.any() else COUNTS:
        if 2 * count > frames:
            break
        rows, weights = _told_by(frames, count)
        if np.abs(weights @ told[rows] - told).max() < 1:
            few.rows.extend((first + rows).tolist())
            few.runs.append((len(rows), weights))
            return
    if frames <= 2 * COUNTS[0]:
        few.rows.extend(range(first, first + frames))
        few.runs.append((frames, None))
        return
    half = frames // 2
    _choose(told[:half], fast[: half - 1], first, few)
    _choose(told[half:], fast[half:], first + half, few)


@cache
def _told_by(frames: int, count: int) -> tuple[NDArray[np.intp], Floats]:
    """Return which frames of a run tell it best, `count` or fewer, m, and the weights of each in all, (frames, m)."""
    middle = (frames - 1) / 2
    rows = np.unique(np.round(chebyshev.points(middle, middle, count)).astype(np.intp))
    count = len(rows)
    others = ~np.eye(count, dtype=bool)
    apart = (rows[:, None] - rows)[others].reshape(count, -1)
    distance = (np.arange(frames)[:, None, None] - rows + np.zeros((count, 1)))[:, others].reshape(frames, count, -1)
    return rows, np.asarray((distance / apart).prod(axis=2))
