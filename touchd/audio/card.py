"""What a source needs from an audio interface, the seam below which a library stands; and what it plays.

That is the chirp once a period, moved by a fraction of a sample.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Chirp

Floats = NDArray[np.float64]
Samples = NDArray[np.int16]


class CardAbsent(Exception):
    """The card cannot be used at present; the text says why."""


class CardGone(Exception):
    """The card was unplugged, or fails; the text says why."""


class CardXrun(Exception):
    """Samples are missing, since the computer was too late: the delay from playback to capture is another."""


class Card(Protocol):
    """An open card that plays and captures at one clock. Every method but `close` may raise CardGone."""

    name: str
    """Stable over replugging and restarts."""
    rate_hz: int
    ahead: int
    """Samples between the call of `play` and the first sample of it that is heard, at most."""

    def start(self, loop: Floats) -> None:
        """Play a loop from its first sample on, again and again, and capture; stop what was played before.

        It has the shape (period,), and is for all outputs, relative to full scale, -1..1.
        """

    def play(self, loop: Floats) -> None:
        """Play another loop of the same length from now on, at the place where the last one stands."""

    def exchange(self, timeout_s: float) -> Samples | None:
        """Return the samples captured next, shape (n, inputs), relative to 2^15; None if none come in time.

        They are a view that is valid until the next call. Each call plays as much as it captures. Raises CardXrun: call
        `start`.
        """

    def close(self) -> None:
        """Release the card; never fails."""


def loop_of(chirp: Chirp, rate_hz: float, period: int, level_dbfs: float) -> Floats:
    """Return a period of what is played, shape (period,), with the chirp at its start."""
    played = chirp.model_copy(update={"dac_rate_hz": rate_hz}).waveform()
    loop = np.zeros(period)
    loop[: len(played)] = played
    return loop * 10 ** (level_dbfs / 20)


def moved(loop: Floats, samples: float) -> Floats:
    """Return periodic signals, (..., period), later by a number of samples, whole or not."""
    turns = np.fft.rfftfreq(loop.shape[-1]) * samples
    return np.asarray(np.fft.irfft(np.fft.rfft(loop) * np.exp(-2j * np.pi * turns), loop.shape[-1]))
