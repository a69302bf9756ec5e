"""Find the feature directions of baseline drift, mostly temperature.

A stale baseline adds the same few patterns to every residual, and the untouched frames of a recording show them. A
network that projects them out tolerates a baseline of another temperature at almost no cost.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

STANDS_OUT = 9.0
"""A pattern counts as drift if the other half of the frames varies this many times more along it than mean noise. White
noise under a Hann window reaches 2.7: its bins correlate with their neighbours, 4/6 and 1/6."""
MOST = 4
_ROWS = 2000


def drift_directions(untouched: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the orthonormal drift directions, shape (k, inputs), of untouched features (n, inputs).

    Rows are in order of time and share no noise. The directions are principal components of one half of the rows that
    exceed the noise in the other half: at most `MOST`, possibly none. The noise is estimated from differences of
    successive rows, because drift is slow.
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
