"""Tell from each frame whether the response to the chirp is there still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ALIKE = 0.4
"""Share of a channel's response at the start that is heard still, at least; a palm leaves more."""
UNLIKE_FRAMES = 3
"""So many frames in a row with less are lost samples, a cable or a knob; fewer may be a knock."""


class Watch:
    """Compares frames with the response at the start.

    Parameters
    ----------
    response : array of shape (channels, samples)
    alive : array of bool, shape (channels,)
        Which of them are heard at all: the others are not watched.
    """

    def __init__(self, response: NDArray[np.float64], alive: NDArray[np.bool_]) -> None:
        energy = np.maximum(np.square(response).sum(axis=1, keepdims=True), 1.0)
        self._template: NDArray[np.float32] = np.where(alive[:, None], response / energy, 0.0).astype(np.float32)
        self._unwatched = np.where(alive, 0.0, 1.0)
        self._unlike = 0

    def lost(self, frame: NDArray[np.float32]) -> list[int]:
        """Return the channels that no longer hear the chirp as they did, once three frames in a row say so."""
        heard = np.vecdot(frame, self._template) + self._unwatched
        self._unlike = self._unlike + 1 if heard.min() < ALIKE else 0
        return np.flatnonzero(heard < ALIKE).tolist() if self._unlike >= UNLIKE_FRAMES else []
