"""What is played: the chirp once a period, moved by a fraction of a sample."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.chirp import waveform
from touchd.errors import ConfigError
from touchd.frame import Chirp

Floats = NDArray[np.float64]


def period_of(rate_hz: float, frame_rate_hz: int) -> int:
    """Return the samples of a period; raises ConfigError unless they are whole."""
    period = rate_hz / frame_rate_hz
    if period != round(period):
        raise ConfigError(
            f"is {frame_rate_hz}: {rate_hz:g} samples a second are no multiple of it", "device.rate_hz",
            "use a divisor, such as 100 or 125",
        )  # fmt: skip
    return round(period)


def loop_of(chirp: Chirp, rate_hz: float, period: int, level_dbfs: float) -> Floats:
    """Return a period of what is played, shape (period,), with the chirp at its start."""
    played = waveform(chirp.model_copy(update={"dac_rate_hz": rate_hz}))
    loop = np.zeros(period)
    loop[: len(played)] = played
    return loop * 10 ** (level_dbfs / 20)


def moved(loop: Floats, samples: float) -> Floats:
    """Return periodic signals, (..., period), later by a number of samples, whole or not."""
    turns = np.fft.rfftfreq(loop.shape[-1]) * samples
    spectrum = np.fft.rfft(loop) * np.exp(-2j * np.pi * turns)
    if loop.shape[-1] % 2 == 0:
        spectrum[..., -1] = spectrum[..., -1].real
    return np.asarray(np.fft.irfft(spectrum, loop.shape[-1]))
