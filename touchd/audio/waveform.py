"""What is played: the chirp once a period, moved by a fraction of a sample."""

from __future__ import annotations

import numpy as np

from touchd.audio.card import Floats
from touchd.errors import ConfigError
from touchd.frame import Acquisition, Chirp


def rates_of(acquisition: Acquisition) -> list[int]:
    """Return the frame rates that whole chirps fill, Hz: in steady state they follow each other without a pause."""
    sample_rate_hz = acquisition.sample_rate_hz
    period = _period(acquisition) or 1
    most_hz = int(sample_rate_hz // max(acquisition.samples, period))
    return [rate_hz for rate_hz in range(1, most_hz + 1) if sample_rate_hz / rate_hz % period == 0]


def periods_of(acquisition: Acquisition, frame_rate_hz: int) -> tuple[int, int]:
    """Return the samples from chirp to chirp, and how many chirps make a frame.

    In steady state chirps follow each other with the acquisition's period, and frames are means of some; else there is
    one chirp a frame. Raises ConfigError unless both are whole.
    """
    fits = rates_of(acquisition)
    if frame_rate_hz not in fits:
        problem = f"is {frame_rate_hz}: no whole number of chirps lasts as long as such a frame"
        if not fits:
            raise ConfigError(problem, "device.rate_hz", "set another audio.chirp_s, such as 0.004: no rate fits")
        raise ConfigError(problem, "device.rate_hz", f"use {fits[-1]}, or a whole part of it")
    samples = round(acquisition.sample_rate_hz / frame_rate_hz)
    period = _period(acquisition) or samples
    return period, samples // period


def _period(acquisition: Acquisition) -> int | None:
    """Return the samples from chirp to chirp in steady state."""
    period_s = acquisition.chirp.period_s
    return None if period_s is None else round(period_s * acquisition.sample_rate_hz)


def loop_of(chirp: Chirp, rate_hz: float, period: int, level_dbfs: float) -> Floats:
    """Return a period of what is played, shape (period,), with the chirp at its start."""
    played = chirp.model_copy(update={"dac_rate_hz": rate_hz}).waveform()
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
