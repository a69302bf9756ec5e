"""Directions in feature space in which the untouched plate moves by itself: its temperature, above all.

A stale baseline adds to every residual the same few patterns, which the recording's own untouched frames
show. What lies along them tells nothing of a finger that could be relied on, so a network need not see it:
with them taken out, a baseline of another temperature costs next to nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

STANDS_OUT = 9.0
"""A pattern is taken for more than noise if frames that it was not found in vary so many times more along it than noise
does on average. White noise under a Hann window reaches 2.7: its bins correlate with their neighbours, 4/6 and 1/6."""
MOST = 4
_ROWS = 2000


def drift_directions(untouched: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the orthonormal directions, shape (k, inputs), in which untouched features (n, inputs) move.

    The rows are in the order of time, without noise in common. The directions are the principal components
    of one half of them that stand out of the noise in the other half; none where nothing does, and at most
    `MOST`. Noise is what differs from row to row: drift is slow.
    """
    n, inputs = untouched.shape
    if n < 2 * MOST:
        return np.zeros((0, inputs), np.float32)
    rows = untouched[np.linspace(0, n - 1, min(n, _ROWS)).astype(int)].astype(np.float64)
    noise = np.mean(np.diff(untouched[: 2 * (n // 2)].reshape(n // 2, 2, inputs), axis=1) ** 2) / 2
    rows -= rows.mean(axis=0)
    _, _, patterns = np.linalg.svd(rows[::2], full_matrices=False)
    along = np.mean((rows[1::2] @ patterns[:MOST].T) ** 2, axis=0)
    return np.asarray(patterns[:MOST][along > STANDS_OUT * noise], np.float32)
