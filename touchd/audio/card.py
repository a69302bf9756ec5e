"""What a source needs from an audio interface, and what may happen to it: the seam below which a library stands."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

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

        Parameters
        ----------
        loop : array of shape (period,)
            For all outputs, relative to full scale, -1..1.
        """

    def play(self, loop: Floats) -> None:
        """Play another loop of the same length from now on, at the place where the last one stands."""

    def exchange(self, timeout_s: float) -> Samples | None:
        """Return the samples captured next, shape (n, inputs), relative to 2^15; None if none come in time.

        They are a view that is valid until the next call. Each call plays as much as it captures.

        Raises
        ------
        CardXrun
            Call `start`.
        """

    def close(self) -> None:
        """Release the card; never fails."""
