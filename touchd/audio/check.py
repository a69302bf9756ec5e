"""Measure an audio interface whose output a cable joins to an input: what it passes, adds, mixes and loses."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from touchd.audio.capture import PASSED, check_band
from touchd.audio.card import Card, CardXrun, Floats, Samples
from touchd.audio.delay import Doubtful, by_loopback, explained

PERIOD_S = 0.25
"""Of what is played: longer than any delay."""
MEASURED = 4
LEVELS_DBFS = (-1.0, -3.0, -6.0, -12.0, -20.0)
LOW_DISTORTION_DB = -60.0
"""Distortion below the noise of a good frame."""
MOST_SPREAD_DB = 0.5
"""Converters and amplifiers keep their gain to a tenth of that at any level."""
MOST_CROSSTALK_DB = -30.0
"""Less comes through the air and inside a box; more is mixed on purpose, or a second cable."""
MOST_ECHO_DB = -20.0
"""Filters ring less, and no longer."""
RINGS_S = 1e-3
PASSED_DB = -12.0
"""The band ends where less passes, relative to where most does."""
AUDIBLE_HZ = 20_000.0
GOOD_DB = 60.0
"""Signal-to-noise ratio that the pages' accuracies are for."""
MOST_OFF = 0.01
"""Relative error of the sample rate by this computer's clock: of a card's clock it is a hundredth of that."""
UNTOUCHED_DBFS = -12.0
"""Level of an untouched plate whose response peaks at 0.6 of full scale."""
HUM_HZ = 1000.0
"""Below lie mains hum, which inputs without a cable hear, and an offset: no cable is told by them."""
HEARD = 10.0
"""An input hears the output that gets this many times as much of it as silence resembles it."""
_FINER = 32  # a period is compared with the next one to this part of a sample
_APART_PPM = 4.0  # of two clocks, which differ by tens
_SETTLE_S = 0.5
"""Converters mute themselves while they start, and filters ring."""
_FULL_SCALE = 2.0**15
_LIMIT = 2**15 - 1

Progress = Callable[[str], object]


@dataclass
class Checked:
    """What was measured; levels are of sines, relative to full scale."""

    device: str
    sample_rate_hz: int
    cable: int
    """The input at the cable, counted from 1."""
    true_rate_hz: float = 0.0
    xruns: int = 0
    seconds: float = 0.0
    noise_dbfs: list[float] = field(default_factory=list)
    """RMS of each input in silence."""
    gain_db: float = 0.0
    """From output to input in the middle of the band."""
    gain_spread_db: float = 0.0
    """How far the gains of tones of different levels are apart that are not distorted: 0 without automatic gain."""
    crosstalk_db: list[float] = field(default_factory=list)
    """Of each input, relative to the cable's; 0 for that one."""
    mixed: list[int] = field(default_factory=list)
    """Inputs that hear so much of the output that it is mixed to them, or that a cable of their own joins them."""
    distortion_db: dict[str, float | None] = field(default_factory=dict)
    """Harmonics of a tone, relative to it, by level played; None where the input clips."""
    delays: list[float] = field(default_factory=list)
    """Samples from playback to capture, of each start."""
    echo_db: float = 0.0
    """What is heard a second time, relative to the first."""
    echo_s: float = 0.0
    """How much later."""
    resamples: str = ""
    """Why the sample rate is not a true one; empty if it is."""
    band_hz: tuple[float, float] = (0.0, 0.0)
    level_dbfs: float = 0.0
    floor_dbfs: float = 0.0
    """Noise of the cable's input, if it were at all frequencies as strong as in the band."""
    frequency_hz: Floats = field(default_factory=lambda: np.zeros(0))
    response_db: Floats = field(default_factory=lambda: np.zeros(0))
    """From output to the cable's input, around each of the frequencies."""
    noise_db: Floats = field(default_factory=lambda: np.zeros(0))
    """Of the cable's input around each of the frequencies, dBFS."""

    @property
    def snr_db(self) -> float:
        """How far noise lies below the chirp at the cable's input."""
        return self.level_dbfs + self.gain_db - self.floor_dbfs

    @property
    def delay_spread(self) -> float:
        """How far the fractions of the delays are apart, samples."""
        fractions = np.exp(2j * np.pi * np.array(self.delays))
        return float(np.abs(np.angle(fractions / fractions.mean())).max() / np.pi) if self.delays else 0.0


def hear(card: Card, loop: Floats) -> Floats:
    """Play a loop, and return the captured periods of it, shape (n, inputs, period), relative to full scale."""
    period = len(loop)
    wanted = MEASURED * period
    for _ in range(3):
        card.start(loop)
        skip = round(_SETTLE_S * card.rate_hz)
        blocks: list[Samples] = []
        taken = 0
        try:
            while taken < skip + wanted:
                block = card.exchange(1.0)
                if block is None:
                    raise Doubtful("the card plays, but captures nothing")
                blocks.append(block.copy())
                taken += len(block)
        except CardXrun:
            continue
        heard = np.concatenate(blocks)[skip : skip + wanted].T / _FULL_SCALE
        return np.asarray(heard.reshape(len(heard), MEASURED, period).swapaxes(0, 1))
    raise Doubtful("samples are lost again and again: end other programs")


def check(card: Card, *, restarts: int, seconds: float, level_dbfs: float, progress: Progress = str) -> Checked:
    """Measure a card.

    `restarts` starts tell how stable the delay is; in `seconds` xruns are counted, and the sample rate is measured.
    `level_dbfs` is that of the sweep, and `progress` receives what is measured next. Raises Doubtful if no input hears
    the output, or samples are lost again and again; CardGone.
    """
    period = round(PERIOD_S * card.rate_hz)
    progress("noise")
    noise = hear(card, np.zeros(period))
    progress("response")
    t = np.arange(period) / card.rate_hz
    # Periodic, of constant amplitude over all that converters pass.
    sweep = np.sin(np.pi * (PASSED * card.rate_hz) / t[-1] * t**2) * 10 ** (level_dbfs / 20)
    periods = hear(card, sweep)
    heard = periods.mean(axis=0)
    listened = _without_hum(sweep, card.rate_hz)[None]
    alike, by_chance = (explained(_without_hum(part, card.rate_hz), listened).max(axis=(1, 2))
                        for part in (heard, noise.mean(axis=0)))  # fmt: skip
    cable, hears = int(np.argmax(alike)), alike > HEARD * by_chance
    loud = np.flatnonzero(np.abs(noise).max(axis=(0, 2)) * _FULL_SCALE >= _LIMIT) + 1
    noise -= noise.mean(axis=2, keepdims=True)
    if len(loud) and (not hears[cable] or cable + 1 in loud):
        raise Doubtful(
            f"input {', '.join(map(str, loud))} clips while nothing is played: switch direct monitoring off, and turn "
            "its gain down"
        )
    if not hears[cable]:
        raise Doubtful(
            "no input hears the output: join one to an input with a cable, unmute it (alsamixer), turn the knobs up"
        )
    _check_one_clock(_without_hum(periods[:, cable], card.rate_hz))
    found = Checked(card.name, card.rate_hz, cable + 1)
    found.noise_dbfs = _db(2 * noise.var(axis=(0, 2))).tolist()
    _take_response(found, heard, sweep, noise[:, cable])
    found.echo_db, found.echo_s = _echo(_without_hum(heard[cable], card.rate_hz), listened[0], card.rate_hz)
    mixed = hears & (np.array(found.crosstalk_db) > MOST_CROSSTALK_DB)
    found.mixed = [i for i in (np.flatnonzero(mixed) + 1).tolist() if i != found.cable]
    try:
        check_band(heard[cable : cable + 1], sweep, card.rate_hz)
    except Doubtful as doubt:
        found.resamples = str(doubt)
    progress("distortion")
    clean: dict[float, float] = {}
    for dbfs in LEVELS_DBFS:
        distortion_db, gain_db = _distortion(card, period, cable, dbfs)
        found.distortion_db[f"{dbfs:g}"] = distortion_db
        if distortion_db is not None and distortion_db < LOW_DISTORTION_DB:
            clean[dbfs] = gain_db
    found.level_dbfs = max(clean, default=LEVELS_DBFS[-1])
    found.gain_spread_db = float(np.ptp(list(clean.values()))) if clean else 0.0
    for number in range(restarts):
        progress(f"start {number + 1} of {restarts}")
        # Of what passes: many cards pass half of what they sample.
        captured = _without_hum(hear(card, sweep).mean(axis=0)[cable], card.rate_hz, found.band_hz[1])
        passed = _without_hum(sweep, card.rate_hz, found.band_hz[1])
        found.delays.append(by_loopback(captured * _FULL_SCALE, passed).samples)
    progress(f"xruns in {seconds:g} s")
    _take_time(found, card, sweep, seconds)
    return found


def _take_response(found: Checked, heard: Floats, sweep: Floats, noise: Floats) -> None:
    """Set what passes from the output to each input, and the noise, (n, period), of the cable's."""
    played = np.fft.rfft(sweep)
    frequency_hz = np.fft.rfftfreq(len(sweep), 1 / found.sample_rate_hz)
    edges_hz = np.geomspace(20, PASSED * found.sample_rate_hz, 121)
    parts = [np.flatnonzero((frequency_hz >= low) & (frequency_hz < high))
             for low, high in itertools.pairwise(edges_hz)]  # fmt: skip
    parts = [part for part in parts if len(part)]
    passed = np.abs(np.fft.rfft(heard)) ** 2
    table = np.array([[row[part].sum() / (np.abs(played[part]) ** 2).sum() for part in parts] for row in passed])
    found.frequency_hz = np.array([frequency_hz[part].mean() for part in parts])
    found.response_db = _db(table[found.cable - 1])
    found.band_hz = _band(found.frequency_hz, found.response_db, found.sample_rate_hz)
    inside = (found.frequency_hz >= found.band_hz[0]) & (found.frequency_hz <= found.band_hz[1])
    found.gain_db = float(np.median(found.response_db[inside]))
    found.crosstalk_db = (_db(table[:, inside].mean(axis=1)) - _db(table[found.cable - 1, inside].mean())).tolist()
    hiss = (np.abs(np.fft.rfft(noise)) ** 2).mean(axis=0) * (2 / len(sweep)) ** 2
    found.noise_db = _db(np.array([hiss[part].sum() for part in parts]))
    band = (frequency_hz >= found.band_hz[0]) & (frequency_hz <= found.band_hz[1])
    found.floor_dbfs = float(_db(hiss[band].mean() * len(hiss)))


def _band(frequency_hz: Floats, response_db: Floats, rate_hz: int) -> tuple[float, float]:
    """Return the band to use: above hearing, as far as half of the sample rate leaves room for, and what passes."""
    low_hz = min(AUDIBLE_HZ, 0.16 * rate_hz)
    above = frequency_hz >= low_hz
    poor = above & (response_db < response_db[above].max() + PASSED_DB)
    end = int(np.argmax(poor)) if poor.any() else len(frequency_hz)
    return round(low_hz, -2), round(max(float(frequency_hz[end - 1]), 1.1 * low_hz), -2)


def _check_one_clock(periods: Floats) -> None:
    """Raise Doubtful if captured periods, (n, period), come later and later: no delay would last."""
    turns = np.fft.rfft(periods[1:]) * np.conj(np.fft.rfft(periods[:-1]))
    fine = np.fft.irfft(turns.sum(axis=0), _FINER * periods.shape[1])
    later = int(np.argmax(fine))
    off_ppm = 1e6 * (later - (later > len(fine) // 2) * len(fine)) / len(fine)
    if abs(off_ppm) > _APART_PPM:
        raise Doubtful(
            f"outputs and inputs run on clocks of their own, {abs(off_ppm):.0f} ppm apart: choose one for both in the "
            "interface's mixer, or take an interface that has one"
        )


def _without_hum(signal: Floats, rate_hz: int, below_hz: float = np.inf) -> Floats:
    """Return periodic signals, (..., period), without mains hum, offset, and what lies above a frequency."""
    spectrum = np.fft.rfft(signal)
    frequency_hz = np.fft.rfftfreq(signal.shape[-1], 1 / rate_hz)
    spectrum[..., (frequency_hz < HUM_HZ) | (frequency_hz > below_hz)] = 0
    return np.asarray(np.fft.irfft(spectrum, signal.shape[-1]))


def _echo(heard: Floats, played: Floats, rate_hz: int) -> tuple[float, float]:
    """Return the largest part of the impulse response beside its peak, relative to that, dB, and how much later, s."""
    spectrum = np.fft.rfft(played)
    power = np.abs(spectrum) ** 2
    answer = np.fft.rfft(heard) * np.conj(spectrum) / np.maximum(power, 0.1 * power.max())
    impulse = np.abs(np.fft.irfft(answer, len(played)))
    impulse = np.roll(impulse, -int(np.argmax(impulse)))
    rings = round(RINGS_S * rate_hz)
    later = rings + int(np.argmax(impulse[rings:-rings]))
    return float(_db(np.square(impulse[later] / max(impulse[0], 1e-30)))), later / rate_hz


def _distortion(card: Card, period: int, cable: int, dbfs: float) -> tuple[float | None, float]:
    """Return the power of a tone's harmonics relative to it, None where the input clips, and its gain, dB."""
    turns = period // 16 // 2 * 2 + 1  # a sixteenth of the sample rate: seven harmonics are heard
    tone = np.sin(2 * np.pi * turns * np.arange(period) / period) * 10 ** (dbfs / 20)
    heard = hear(card, tone)[:, cable]
    clips = np.abs(heard).max() * _FULL_SCALE >= _LIMIT
    spectrum = np.abs(np.fft.rfft(heard.mean(axis=0))) ** 2
    harmonics = np.arange(2, 7) * turns
    power = max(spectrum[turns], 1e-30)
    distortion_db = float(_db(np.array(spectrum[harmonics].sum() / power)))
    return None if clips else distortion_db, float(_db(np.array(power))) - dbfs


def _take_time(found: Checked, card: Card, loop: Floats, seconds: float) -> None:
    """Count xruns, and samples against this computer's clock."""
    card.start(loop)
    began, samples, first = time.monotonic(), 0, 0.0
    arrived: list[tuple[float, int]] = []
    while (now := time.monotonic()) - began < seconds:
        try:
            block = card.exchange(0.5)
        except CardXrun:
            found.xruns += 1
            card.start(loop)
            samples, arrived = 0, []
            continue
        samples += 0 if block is None else len(block)
        first = first or now
        arrived.append((time.monotonic(), samples))
    found.seconds = seconds
    times, counts = np.array(arrived).T if len(arrived) > 1 else np.zeros((2, 2))
    if np.ptp(times) > 0:
        found.true_rate_hz = float(np.polyfit(times - times[0], counts, 1)[0])


def _db(power: NDArray[np.floating]) -> Floats:
    return np.asarray(10 * np.log10(np.maximum(power, 1e-20)))
