"""How well touches fit the model, judged without knowing where they were."""

from __future__ import annotations

from collections import deque
from statistics import median

REMEMBERED = 64
"""Touches that count: the last ones."""
LEAST = 8
"""Fewer touches say nothing: one may be a palm."""
LOUD = 2.0
"""A frame counts if its signal exceeds the noise energy by this factor."""
WORN = 0.03
"""A median touch that leaves more than this share unexplained calls for another calibration. Right models leave 0.001
to 0.01, of thumbs on a plate of 100 mm 0.029; tape on an edge that the model lacks 0.01 to 0.026, transducers tilted
by 30 degrees and 3 dB 0.08, a disc 3 mm off 0.1 and more (twin)."""


class ModelFit:
    """Keeps the share of each touch's energy that its fits leave unexplained; each touch counts once."""

    def __init__(self) -> None:
        self._shares: deque[float] = deque(maxlen=REMEMBERED)
        self._left = self._signal = 0.0

    def add(self, left: float, signal: float, noise_energy: float) -> None:
        """Take one fitted frame.

        Parameters
        ----------
        left : float
            Energy that the fit leaves, less the noise's.
        signal : float
            Energy of the frame, less the noise's.
        noise_energy : float
        """
        if signal > LOUD * noise_energy:
            self._left += left
            self._signal += signal

    def end_touch(self) -> None:
        """Count what was added since the last touch as one touch."""
        if self._signal > 0:
            self._shares.append(max(self._left / self._signal, 0.0))
            self._left = self._signal = 0.0

    @property
    def value(self) -> float | None:
        """Share of a touch's energy that the model explains, 0..1, median of the last touches; None of too few."""
        return max(1 - median(self._shares), 0.0) if len(self._shares) >= LEAST else None
