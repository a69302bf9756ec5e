"""What the detector makes of one frame."""

from __future__ import annotations

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from touchd.detection.baseline import Signal
from touchd.detection.pace import USUAL_NS
from touchd.outcome import Outcome


class Detection(Struct, gc=False, frozen=True):
    """What the detector makes of one frame. Its arrays are views, valid until the next frame."""

    outcome: Outcome
    """REPEATED, STUCK, LEARNING, UNTOUCHED or TOUCHED."""
    t_ns: int
    energy: float
    """Of the residual, counts squared; without that of the drive's own changes."""
    noise_root: float
    noise_deviation: float
    """Mean and standard deviation of the cube root of the energy of untouched frames' residuals."""
    signal: Signal
    """The frame, shape (channels, samples), ADC counts."""
    residual: Signal
    """The frame less the baseline; zero in channels that are not live."""
    baseline: Signal
    """The untouched plate, shape (channels, samples)."""
    live: NDArray[np.bool_]
    """Channels that are not stuck, shape (channels,). Another object whenever one changes."""
    noise_changed: bool = False
    """Whether the noise level has stepped."""
    learned: Signal | None = None
    """Residuals of the frames that the baseline was learned from, (n, channels, samples), once it is learned."""
    lost: int = 0
    """Frames missing before this one."""
    period_ns: int = USUAL_NS
    """From frame to frame at the present rate."""
    tones_hz: tuple[float, ...] = ()
    """Tones that were taken out of the residual. Another object whenever one changes."""
    hits: tuple[int, ...] = ()
    """Starts of the runs of samples that an impulse has hit; the residual is zero there."""
    rings: bool = False
    """Whether the plate rings from a knock: outside the chirp's band it is louder than fingers and noise are."""

    sounds: bool = False
    """Whether it is louder there for longer than an impulse lasts: it rings, or something slides on it."""

    @property
    def noise_energy(self) -> float:
        """Mean energy of the residual of an untouched frame, counts squared."""
        return self.noise_root**3

    def energy_above(self, quantile: float) -> float:
        """Return the energy that untouched frames exceed as a normal deviate exceeds the quantile, counts squared."""
        return (self.noise_root + quantile * self.noise_deviation) ** 3
