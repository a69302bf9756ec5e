"""Which frames of a plate in use are those between touches: frames that are the same again and again.

Between touches frames differ by noise alone. So do those of a finger that rests, but the next one is elsewhere, or
presses more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.floating]

_LEAST_SHARE = 4
"""A quarter of a window's frames are alike at least, ..."""
_ALIKE = 1.5
"""... and differ by at most this much more energy than those nearest to each other. Of noise it hardly varies."""
_KEPT = 64
"""Of each group at most so many frames are kept."""
SOON_WINDOWS, LEAST_WINDOWS = 6, 3
"""So many windows have them in common; the fewer where nothing better is to be had."""


class QuietFrames:
    """Looks for them in one window of frames after the other."""

    def __init__(self) -> None:
        self._found: list[Frames] = []
        self._overlaps = False

    def add(self, frames: Frames) -> None:
        """Take a window of frames, shape (n, channels, samples). Each overlaps its predecessor by half of it."""
        if not self._overlaps:
            self._found += _alike(frames)
        self._overlaps = not self._overlaps

    def latest(self, count: int, windows: int) -> Frames | None:
        """Return up to `count` frames, the last ones, of those that most windows have; None where fewer have any."""
        if not self._found:
            return None
        means = np.array([frames.mean(axis=0).ravel() for frames in self._found])
        noise = np.array([frames.var(axis=0).sum() for frames in self._found])
        same = _distances(means) < noise
        most = int(same.sum(axis=1).argmax())
        if same[most].sum() < windows:
            return None
        return np.concatenate([self._found[k] for k in np.flatnonzero(same[most])])[-count:]


def _alike(frames: Frames) -> list[Frames]:
    """Return the frames of a window that differ by noise alone, in groups of a quarter of them at least."""
    apart, groups = _distances(frames.reshape(len(frames), -1)), []
    left, least, most = np.arange(len(frames)), max(len(frames) // _LEAST_SHARE, 2), np.inf
    while len(left) >= least:
        there = apart[np.ix_(left, left)]
        reach = np.partition(there, least - 1, axis=1)[:, least - 1]
        middle, nearest = int(reach.argmin()), float(reach.min())
        if nearest > most:
            break
        near, most = there[middle] <= _ALIKE * nearest, min(most, _ALIKE * nearest)
        groups.append(frames[left[near]][:_KEPT])
        left = left[~near]
    return groups


def _distances(rows: Frames) -> NDArray[np.float64]:
    """Return the energy by which any two rows differ, shape (n, n)."""
    off = rows.astype(np.float64) - rows.mean(axis=0, dtype=np.float64)
    products = off @ off.T
    energy = np.diag(products)
    return np.asarray(energy[:, None] + energy - 2 * products)
