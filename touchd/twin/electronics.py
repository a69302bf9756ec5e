"""Convert the receivers' signals to ADC counts: gains, noise, interference, faults, quantisation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Acquisition
from touchd.twin.physics.filters import high_pass

Floats = NDArray[np.float64]


class Tone(NamedTuple):
    """A sine asynchronous to the chirp, such as a charger's."""

    frequency_hz: float
    level_db: float
    """RMS relative to the untouched signal."""
    start_s: float = 0.0
    stop_s: float = np.inf
    finger: bool = False
    """Whether it comes in through a finger, and only while one is on the plate: a charger's common-mode current,
    50 dB below the signal or more in a wired rig."""


class Impulses(NamedTuple):
    """Electromagnetic impulses, as of a relay or a mains switch: a few samples of some frames, in all channels."""

    share: float = 0.05
    """Share of the frames that are hit."""
    level_db: float = -10.0
    """RMS of the hit samples relative to the untouched signal's. A fast transient of IEC 61000-4-4 couples 10 to 100 mV
    into 30 cm of unshielded cable, beside some 300 mV of signal."""
    samples: int = 4
    """Longest impulse; a burst's spike of 50 ns rings for some microseconds in the anti-alias filter."""


class Ripple(NamedTuple):
    """How the drive's level follows its supply. A driver without regulation hands on all: 50 mV on 5 V are 1 %."""

    share: float = 1e-3
    """RMS, of the level."""
    hz: float = 100.0
    """Of a rectified mains; 0 of what differs from frame to frame by chance."""


class Dead(NamedTuple):
    """A receiver whose wire breaks."""

    channel: int
    start_s: float = 0.0


class Electronics(NamedTuple):
    """Electronics between the receivers and the counts."""

    noise_db: float = 60.0
    """Signal-to-noise ratio of the untouched plate, for white noise; inf for none."""
    peak: float = 0.6
    """Peak of the untouched signal relative to full scale; above 1 it clips."""
    gains: tuple[float, ...] = ()
    """Gain per channel; empty for all 1."""
    gain_drift_per_s: tuple[float, ...] = ()
    """Relative gain change per second and channel; empty for none."""
    jitter_s: float = 0.0
    """Standard deviation of the trigger time."""
    tones: tuple[Tone, ...] = ()
    dead: tuple[Dead, ...] = ()
    image_db: float | None = None
    """Level of the chirp's image around the DAC rate, relative to the signal; -15 dB before the transducer."""
    impulses: Impulses | None = None
    ripple: Ripple | None = None
    crosstalk_db: float | None = None
    """Level of each channel in its neighbours: -50 dB on a board with one multiplexed converter, -80 dB with a
    converter a channel (datasheets of the AD7606 and of NI's multiplexed cards)."""
    inl_lsb: float = 0.0
    """Peak of the integral nonlinearity, an S over the range: 2 to 8 LSB of 16 bits (the same datasheets)."""


class Digitiser:
    """Converts signals to counts, frame by frame: R channels, S samples.

    One generator draws the noise frame by frame, so results do not depend on the block size; it goes on from `noise`, a
    state returned by `noise_states`. `untouched`, of shape (R, S), is the signal of the untouched plate at the
    reference temperature, peak 1. Raises SimulationError if a setting does not fit the channels.
    """

    def __init__(
        self,
        electronics: Electronics,
        acquisition: Acquisition,
        untouched: Floats,
        seed: np.random.SeedSequence,
        noise: Mapping[str, Any] | None = None,
    ) -> None:
        channels = acquisition.channels
        for name in ("gains", "gain_drift_per_s"):
            given = len(getattr(electronics, name))
            if given not in (0, channels):
                raise SimulationError(f"{given} {name} for {channels} channels", "electronics", "give one per channel")
        if any(not 0 <= dead.channel < channels for dead in electronics.dead):
            raise SimulationError("a dead channel that does not exist", "electronics", f"use 0 .. {channels - 1}")
        if electronics.peak <= 0 or electronics.jitter_s < 0:
            raise SimulationError("a negative peak or jitter", "electronics", "use positive numbers")
        self._e = electronics
        self._a = acquisition
        self._rms = float(np.sqrt(np.mean(untouched**2)))
        varying, fixed = seed.spawn(2)
        self._impulse_key = int(seed.generate_state(1)[0])
        self._noise = np.random.default_rng(varying)
        if noise is not None:
            self._noise.bit_generator.state = noise
        rng = np.random.default_rng(fixed)
        self._phases = rng.uniform(0, 2 * np.pi, len(electronics.tones))
        self._image = _image(acquisition, electronics.image_db, self._rms, rng)

    def counts(self, signal: Floats, time_s: Floats, touched: NDArray[np.bool_] | None = None) -> NDArray[np.int16]:
        """Digitise the next frames: `signal` (n, R, S) in units of the untouched signal's peak, which is overwritten.

        `time_s` (n,) is the start of each chirp, `touched` (n,) whether a finger is on the plate; by default in none.
        """
        e, a = self._e, self._a
        signal += self._image
        if e.crosstalk_db is not None:
            beside = np.pad(signal, ((0, 0), (1, 1), (0, 0)))
            signal += 10 ** (e.crosstalk_db / 20) * (beside[:, :-2] + beside[:, 2:])
        if e.gains:
            signal *= np.array(e.gains)[:, None]
        if e.gain_drift_per_s:
            signal *= (1 + time_s[:, None] * np.array(e.gain_drift_per_s))[..., None]
        moment = time_s[:, None] + np.arange(a.samples) / a.sample_rate_hz
        for tone, phase in zip(e.tones, self._phases, strict=True):
            on = (time_s >= tone.start_s) & (time_s < tone.stop_s)
            if tone.finger:
                on &= False if touched is None else touched
            passed = float(abs(high_pass(2 * np.pi * tone.frequency_hz, a)))
            amplitude = passed * np.sqrt(2) * self._rms * 10 ** (tone.level_db / 20)
            # Remove whole turns first: at 1e8 rad a sine has lost half of its digits.
            turn = np.modf(tone.frequency_hz * moment)[0]
            signal += (on[:, None] * amplitude * np.sin(2 * np.pi * turn + phase))[:, None, :]
        if e.impulses is not None:
            self._add_impulses(signal, time_s, e.impulses)
        full_scale = 2 ** (a.bits - 1)
        for dead in e.dead:
            signal[time_s >= dead.start_s, dead.channel] = 0.0
        noise = self._noise.standard_normal(signal.shape)
        signal += self._rms * 10 ** (-e.noise_db / 20) * noise
        signal *= e.peak * full_scale
        if e.inl_lsb:
            signal += e.inl_lsb * np.sin(2 * np.pi / full_scale * np.clip(signal, -full_scale, full_scale))
        rounded = np.rint(signal)
        return np.asarray(np.clip(rounded, -full_scale, full_scale - 1), dtype=np.int16)

    def _add_impulses(self, signal: Floats, time_s: Floats, impulses: Impulses) -> None:
        """Add an impulse to a share of the frames; a frame's is drawn from its time alone, in any division."""
        for frame, at_s in zip(signal, time_s, strict=True):
            rng = np.random.default_rng((self._impulse_key, round(at_s * 1e9)))
            if rng.uniform() < impulses.share:
                start = rng.integers(frame.shape[1])
                hit = frame[:, start : start + rng.integers(1, impulses.samples + 1)]
                hit += self._rms * 10 ** (impulses.level_db / 20) * rng.standard_normal(hit.shape)


def rippled(
    signal: Floats, time_s: Floats, starts_s: NDArray[np.floating], acquisition: Acquisition, ripple: Ripple,
    seed: int | Sequence[int],
) -> Floats:  # fmt: skip
    """Return what the plate answers, (n, R, S), to a drive that ripples: each frequency by the level as it is emitted.

    `time_s` (n,) is the start of each frame, of which the chirps after `starts_s` (k,) are averaged. By its time and
    the seed alone a frame's level is drawn, in any division.
    """
    a, chirp, key = acquisition, acquisition.chirp, np.atleast_1d(seed).tolist()
    if not ripple.hz:
        drawn = [np.random.default_rng([*key, round(at_s * 1e9)]).standard_normal() for at_s in time_s.tolist()]
        return np.asarray(signal * (1 + ripple.share * np.array(drawn))[:, None, None])
    frequency_hz = np.fft.rfftfreq(a.samples, 1 / a.sample_rate_hz)
    share = np.clip((frequency_hz - chirp.start_hz) / (chirp.stop_hz - chirp.start_hz), 0, 1)
    turn = np.random.default_rng(key).uniform()
    at_s = time_s[:, None, None] + starts_s[:, None] + chirp.duration_s * share
    level = 1 + np.sqrt(2) * ripple.share * np.sin(2 * np.pi * (np.modf(ripple.hz * at_s)[0] + turn)).mean(axis=1)
    return np.asarray(np.fft.irfft(np.fft.rfft(signal) * level[:, None], a.samples))


def noise_states(seed: int | Sequence[int], values: int, frames: Iterable[int]) -> list[dict[str, Any]]:
    """Return the state of a recording's noise generator before each of the given frames, in ascending order.

    `values` is channels times samples. The noise is drawn and discarded, because a normal variate takes a varying
    number of generator steps.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[2].spawn(2)[0])
    states: list[dict[str, Any]] = []
    done = 0
    for frame in frames:
        for at in range(done, frame, 64):
            rng.standard_normal((min(frame - at, 64)) * values)
        done = frame
        states.append(dict(rng.bit_generator.state))
    return states


def _image(acquisition: Acquisition, level_db: float | None, rms: float, rng: np.random.Generator) -> Floats:
    """Return a substitute for the chirp's image at 400 .. 450 kHz aliased into the band, shape (R, S).

    The twin's plate ends at half the sample rate, so the image passes a random reverberation of 1 ms instead. It keeps
    the properties that matter: synchronous with the chirp, inside the band, unchanged by a touch.
    """
    shape = (acquisition.channels, acquisition.samples)
    if level_db is None:
        return np.zeros(shape)
    time_s = np.arange(acquisition.samples) / acquisition.sample_rate_hz
    played = acquisition.chirp.model_copy(update={"dac_rate_hz": acquisition.sample_rate_hz}).waveform()
    room = rng.standard_normal(shape) * np.exp(-time_s / 1e-3)
    wave = np.array([np.convolve(played, row)[: shape[1]] for row in room])
    return np.asarray(wave / np.sqrt(np.mean(wave**2)) * rms * 10 ** (level_db / 20))
