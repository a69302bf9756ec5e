"""A tone is a line that explains what a contact does not; it is taken out of the frames, and of them alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from touchd.detection.tones import MOST, Tones
from touchd.frame import ACQUISITIONS

USB = ACQUISITIONS["usb"]
CHANNELS, SAMPLES = USB.shape
NOISE_ENERGY = float(CHANNELS * SAMPLES)
Frames = NDArray[np.float32]


def noise(rng: np.random.Generator) -> Frames:
    return rng.standard_normal((CHANNELS, SAMPLES)).astype(np.float32)


def tone(frequency_hz: float, level: float, rng: np.random.Generator) -> Frames:
    """A tone of any phase in each channel, of this energy over that of noise."""
    turns = frequency_hz / USB.sample_rate_hz * np.arange(SAMPLES) + rng.uniform(size=(CHANNELS, 1))
    return np.asarray(np.sqrt(2 * level) * np.sin(2 * np.pi * turns), np.float32)


def contact(rng: np.random.Generator, level: float = 300.0) -> Frames:
    """A chirp as a plate may change it: echoes of it, of other strength in each channel."""
    t = np.arange(SAMPLES) / USB.sample_rate_hz
    chirp = np.sin(2 * np.pi * (50e3 * t + 25e6 * t**2))
    taps = rng.standard_normal((CHANNELS, 60)) * np.exp(-np.arange(60) / 15)
    signal = np.stack([np.convolve(chirp, one)[:SAMPLES] for one in taps])
    return np.asarray(signal * np.sqrt(level * NOISE_ENERGY / np.square(signal).sum()), np.float32)


def without_line(residual: Frames, frequency_hz: float) -> Frames:
    """The frame less its best sinusoid and the slope of one, by least squares in float64."""
    t = np.arange(residual.shape[1]) - (residual.shape[1] - 1) / 2
    line = np.exp(2j * np.pi * frequency_hz / USB.sample_rate_hz * t)
    lines = np.stack([line.real, line.imag, t * line.real, t * line.imag], axis=1)
    amplitudes = np.linalg.lstsq(lines, residual.T.astype(float), rcond=None)[0]
    return np.asarray(residual - (lines @ amplitudes).T, np.float32)


def energy(residual: Frames) -> float:
    return float(np.square(residual).sum())


@given(frequency_hz=st.floats(5e3, 115e3), level=st.floats(1, 1000), seed=st.integers(0, 99))
@settings(deadline=None, max_examples=50)
def test_found(frequency_hz: float, level: float, seed: int) -> None:
    """A tone is found in the first frame that has it, at its frequency; nothing of it is left in those that follow."""
    rng, tones = np.random.default_rng(seed), Tones(USB)
    first = noise(rng) + tone(frequency_hz, level, rng)
    assert tones.find(first, NOISE_ENERGY)
    assert tones.known_hz == pytest.approx((frequency_hz,), abs=150)
    later = [noise(rng) + tone(frequency_hz, level, rng) for _ in range(8)]
    for residual in later:
        tones.remove(residual)
    assert np.mean([energy(one) for one in (first, *later)]) < 1.15 * NOISE_ENERGY


@given(seed=st.integers(0, 999))
@settings(deadline=None, max_examples=100)
def test_neither_noise_nor_contacts(seed: int) -> None:
    """Neither noise nor a contact is a tone, nor a contact that lands, moves and lifts."""
    rng, tones = np.random.default_rng(seed), Tones(USB)
    frames = [noise(rng), noise(rng) + contact(rng), noise(rng) + contact(rng), noise(rng)]
    assert not any(tones.find(residual, NOISE_ENERGY) for residual in frames)
    assert tones.known_hz == ()


@given(frequency_hz=st.floats(5e3, 115e3), level=st.floats(1, 30), seed=st.integers(0, 99), odd=st.booleans())
@settings(deadline=None, max_examples=50)
def test_beside_a_contact(frequency_hz: float, level: float, seed: int, odd: bool) -> None:
    """A tone that begins while a stronger contact rests is found; of the contact goes only what lies in its line."""
    acquisition = USB.model_copy(update={"samples": SAMPLES - odd})
    rng, tones = np.random.default_rng(seed), Tones(acquisition)
    resting = contact(rng)
    before, whole = ((resting + noise(rng))[:, : acquisition.samples] for _ in range(2))
    residual = whole + tone(frequency_hz, level, rng)[:, : acquisition.samples]
    assert not tones.find(before.copy(), NOISE_ENERGY)
    assert tones.find(residual, NOISE_ENERGY)
    assert tones.known_hz == pytest.approx((frequency_hz,), abs=300)
    assert energy(residual - without_line(whole, tones.known_hz[0])) < 0.01 * NOISE_ENERGY


def test_several() -> None:
    """Tones that begin together are found together: three alike, none of which is half of what is heard."""
    rng, tones = np.random.default_rng(1), Tones(USB)
    together = 52e3, 73e3, 116e3
    residual = noise(rng) + sum((tone(one, 3.0, rng) for one in together), np.zeros(USB.shape, np.float32))
    assert tones.find(residual, NOISE_ENERGY)
    assert sorted(tones.known_hz) == pytest.approx(together, abs=200)
    assert energy(residual) < 1.15 * NOISE_ENERGY


def test_limit() -> None:
    """More tones than `MOST` stay in the frame: they are noise."""
    rng, tones = np.random.default_rng(1), Tones(USB)
    for k in range(MOST + 2):
        tones.find(noise(rng) + tone(20e3 + 9e3 * k, 100.0, rng), NOISE_ENERGY)
        tones.end_touch()
    assert len(tones.known_hz) == MOST


def test_renewed() -> None:
    """A tone that goes on stays as it was found; one that has ended is forgotten, one that has moved followed."""
    rng, tones = np.random.default_rng(1), Tones(USB)
    tones.find(noise(rng) + tone(62_350.0, 50.0, rng), NOISE_ENERGY)
    before = tones.known_hz
    tones.renew(noise(rng) + tone(62_350.0, 50.0, rng), NOISE_ENERGY)
    assert tones.known_hz is before
    tones.renew(noise(rng) + tone(64_000.0, 50.0, rng), NOISE_ENERGY)
    assert tones.known_hz == pytest.approx((64_000.0,), abs=100)
    tones.renew(noise(rng), NOISE_ENERGY)
    assert tones.known_hz == ()


@pytest.mark.parametrize("level", [0.0, 10.0])
def test_learned(level: float) -> None:
    """Of the frames that the baseline is learned from the tones are taken out; white noise has none."""
    rng, tones = np.random.default_rng(1), Tones(USB)
    frames = np.stack([noise(rng) + tone(81_250.0, level, rng) for _ in range(32)])
    assert tones.learn(frames) is (level > 0)
    assert energy(frames) / 32 == pytest.approx(NOISE_ENERGY, rel=0.05)


def test_few_samples() -> None:
    """Frames too short to tell lines apart have no tones."""
    short = USB.model_copy(update={"samples": 12})
    assert not Tones(short).find(np.ones(short.shape, np.float32), 1.0)
    assert not Tones(short).learn(np.ones((4, *short.shape), np.float32))


@pytest.mark.parametrize("name", ["audio-96", "audio-192"])
def test_steady_state(name: str) -> None:
    """In frames that are whole periods a contact's harmonics are lines, which are no tones."""
    acquisition = ACQUISITIONS[name]
    channels, samples = acquisition.shape
    harmonic = np.sin(2 * np.pi * 30 * np.arange(samples) / samples) * np.ones((channels, 1))
    tones = Tones(acquisition)
    assert not tones.find(harmonic.astype(np.float32), 1.0)
    assert not tones.learn(np.stack([harmonic, -harmonic] * 8).astype(np.float32))
