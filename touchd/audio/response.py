"""What the response to the chirp tells: a card may have a sample rate in name alone, a disc may be lost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.audio.card import Floats
from touchd.audio.delay import Doubtful

LOWER_RATES_HZ = (44_100, 48_000, 88_200, 96_000, 176_400, 192_000, 352_800, 384_000)
MISSING = 10**-3.5
"""What arrives above half of a lower sample rate, relative to the rest: less is what a resampling filter leaves."""
PASSED = 0.45
"""Share of the sample rate up to which any converter passes."""
_BESIDE = 1.03
_LEAST_SHARE = 0.05
ALIKE = 0.4
"""Share of a channel's response at the start that is heard still, at least; a palm leaves more."""
UNLIKE_FRAMES = 3
"""So many frames in a row with less are lost samples, a cable or a knob; fewer may be a knock."""


def check_band(captured: Floats, loop: Floats, rate_hz: float) -> None:
    """Raise Doubtful if a card resamples: nothing arrives above half of a lower sample rate.

    Parameters
    ----------
    captured : array of shape (channels, period)
    loop : array of shape (period,)
        What is played.
    """
    played = np.abs(np.fft.rfft(loop)) ** 2
    heard = (np.abs(np.fft.rfft(captured)) ** 2).sum(axis=0)
    frequency_hz = np.fft.rfftfreq(len(loop), 1 / rate_hz)
    band = (played > 0.1 * played.max()) & (frequency_hz < PASSED * rate_hz)
    for lower_hz in LOWER_RATES_HZ:
        above = band & (frequency_hz > _BESIDE * lower_hz / 2)
        below = band & (frequency_hz < lower_hz / 2 / _BESIDE)
        if lower_hz >= rate_hz or above.sum() < _LEAST_SHARE * band.sum() or not below.any():
            continue
        if heard[above].mean() < MISSING * heard[below].mean():
            raise Doubtful(
                f"nothing arrives above {lower_hz / 2e3:g} kHz: the card has {rate_hz:g} samples a second in name "
                f"alone, or filters; set audio.sample_rate_hz = {lower_hz}, and a band below half of it"
            )


class Watch:
    """Compares frames with the response at the start.

    Parameters
    ----------
    response : array of shape (channels, samples)
    alive : array of bool, shape (channels,)
        Which of them are heard at all: the others are not watched.
    """

    def __init__(self, response: Floats, alive: NDArray[np.bool_]) -> None:
        energy = np.maximum(np.square(response).sum(axis=1, keepdims=True), 1.0)
        self._template: NDArray[np.float32] = np.where(alive[:, None], response / energy, 0.0).astype(np.float32)
        self._unwatched = np.where(alive, 0.0, 1.0)
        self._unlike = 0

    def lost(self, frame: NDArray[np.float32]) -> list[int]:
        """Return the channels that no longer hear the chirp as they did, once three frames in a row say so."""
        heard = np.vecdot(frame, self._template) + self._unwatched
        self._unlike = self._unlike + 1 if heard.min() < ALIKE else 0
        return np.flatnonzero(heard < ALIKE).tolist() if self._unlike >= UNLIKE_FRAMES else []
