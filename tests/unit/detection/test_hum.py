"""Hum, an offset that is another in each frame, leaves residuals; what a finger changes stays in them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.fields import RIG, Field, untouched
from touchd.config.schema import Settings
from touchd.detection.detector import Detector
from touchd.detection.hum import FAR_BELOW, Hum
from touchd.frame import ACQUISITIONS, Frame
from touchd.outcome import Outcome

SIGMA = 2.0
FINGER = Field().residual([(60.0, 45.0, 0.3 + 0.2j)])
GEOMETRIES = sorted(ACQUISITIONS)


def noise(seed: int, n: int) -> np.ndarray:
    return SIGMA * np.random.default_rng(seed).standard_normal((n, *RIG.shape))


def hum(seed: int, n: int, level: float, frequency_hz: float = 50.0, name: str = "usb") -> np.ndarray:
    """A tone in frames that begin at any of its moments, alike in all channels."""
    a, rng = ACQUISITIONS[name], np.random.default_rng(seed)
    turns = rng.uniform(size=(n, 1)) + frequency_hz * np.arange(a.samples) / a.sample_rate_hz
    return np.repeat(level * np.sin(2 * np.pi * turns)[:, None], a.channels, axis=1)


def knowing(name: str, dtype: type = np.float64) -> Hum:
    known = Hum(ACQUISITIONS[name], dtype)
    assert known.learn(hum(1, 32, 1000.0, name=name).astype(dtype))
    return known


@pytest.mark.parametrize("name", GEOMETRIES)
@given(share=st.floats(0, 1), seed=st.integers(0, 99))
def test_nothing_is_left_of_it(name: str, share: float, seed: int) -> None:
    """At any frequency up to a tenth of the band's lower edge, and any phase: less than -70 dB."""
    a = ACQUISITIONS[name]
    frame = hum(seed, 1, 1000.0, share * FAR_BELOW * a.chirp.band_hz[0], name)[0]
    knowing(name).remove(frame)
    assert np.sqrt(np.square(frame).mean()) < 1000 / np.sqrt(2) * 10 ** (-70 / 20)


@given(level=st.floats(1, 1e4), seed=st.integers(0, 99))
def test_fast_as_exact(level: float, seed: int) -> None:
    """In float32 what is left differs from float64 by rounding alone."""
    frame = (FINGER + hum(seed, 1, level)[0]).astype(np.float32)
    exact = frame.astype(np.float64)
    knowing("usb", np.float32).remove(frame)
    knowing("usb").remove(exact)
    np.testing.assert_allclose(frame, exact, atol=3e-6 * (level + np.abs(FINGER).max()))


def test_a_finger_stays() -> None:
    """It has little so far below the chirp's band, and its bins in the band are the same."""
    frame = FINGER.astype(np.float64)
    knowing("usb").remove(frame)
    assert np.square(frame - FINGER).sum() < 0.03 * np.square(FINGER).sum()
    before, after = (np.fft.rfft(each * RIG.window(0.25))[:, 55:96] for each in (FINGER, frame))
    assert np.abs(after - before).max() < 3e-3 * np.abs(before).max()


@pytest.mark.parametrize(("level", "known"), [(0.0, False), (0.3, False), (2.0, True), (3000.0, True)])
def test_it_is_learned_where_it_matters(level: float, known: bool) -> None:
    """White noise does not count as hum, nor does a tenth of its energy more at low frequencies."""
    residuals = noise(3, 32) + hum(4, 32, level)
    found = Hum(RIG, np.float64)
    assert found.learn(residuals) is known
    assert residuals.std() == pytest.approx(SIGMA * np.sqrt(found.white_left), rel=0.03)


def test_impulses_are_none() -> None:
    """Not while the plate is learned: some frames are hit, and the mean with them."""
    residuals = noise(5, 32)
    residuals[[3, 11, 25], :, 100:103] += 3000.0
    residuals -= residuals.mean(axis=0)
    assert not Hum(RIG, np.float64).learn(residuals)


@pytest.mark.parametrize("begins", [0, 120])
@pytest.mark.parametrize("level", [20.0, 300.0, 3000.0])
def test_touches_are_told_from_it(begins: int, level: float) -> None:
    """The gate opens for fingers alone, whether it was there from the start or begins later."""
    detector = Detector(RIG, Settings(), lambda *_: None)
    sounds = hum(6, 300, level)
    told = []
    for n in range(300):
        frame = 10 * untouched() + noise(n, 1)[0] + sounds[n] * (n >= begins) + FINGER * (n % 20 >= 15 and n > 64)
        detection = detector.detect(Frame(np.rint(frame).astype(np.int16), n, n * 8_000_000, 0))
        if detection.outcome is Outcome.TOUCHED:
            detection = detector.clean(detection)
        if detection.outcome is not Outcome.LEARNING:
            told.append((detection.outcome is Outcome.TOUCHED) == (n % 20 >= 15 and n > 64))
            detector.adapt(detection, detection.outcome is Outcome.TOUCHED, False, False)
    assert told.count(False) <= 1  # the first frame of it may count as touched
    assert detector.noise_counts() == pytest.approx(SIGMA, rel=0.1)


def test_long_frames_stay_cheap() -> None:
    """Of a tenth of a second there are thousands of frequencies below the band; mains are among those looked at."""
    long = ACQUISITIONS["audio-192"].model_copy(update={"samples": 19_200})
    turns = np.arange(32)[:, None] * 0.37 + 50.0 * np.arange(long.samples) / long.sample_rate_hz
    residuals = np.repeat(1000 * np.sin(2 * np.pi * turns)[:, None], long.channels, axis=1)
    found = Hum(long, np.float64)
    assert found.learn(residuals)
    assert found.white_left > 0.99
    assert np.abs(residuals).max() < 1.0


def sound(seed: int, n: int, level: float) -> NDArray[np.float64]:
    """Of a loudspeaker: a few tones up to 12 kHz at a time, others in each third of a second."""
    rng, found = np.random.default_rng(seed), []
    for start in range(0, n, 40):
        hz = np.exp(rng.uniform(np.log(150), np.log(12e3), 12))
        time_s = np.arange(start, start + 40)[:, None, None] * 8e-3 + np.arange(RIG.samples) / RIG.sample_rate_hz
        waves = np.sin(2 * np.pi * hz[:, None, None, None] * time_s + rng.uniform(0, 6, (12, 1, 4, 1)))
        found.append(level * rng.uniform(0.1, 1.5) * waves.sum(axis=0))
    return np.concatenate(found)[:n]


@pytest.mark.parametrize("begins", [0, 120])
@pytest.mark.parametrize("level", [5.0, 50.0, 300.0])
def test_touches_are_told_from_a_loudspeaker(begins: int, level: float) -> None:
    """Once it has sounded for some seconds."""
    detector, frames = Detector(RIG, Settings(), lambda *_: None), 1200
    sounds = sound(6, frames, level)
    told = []
    for n in range(frames):
        touches = n % 160 >= 150
        frame = 10 * untouched() + noise(n, 1)[0] + sounds[n] * (n >= begins) + FINGER * touches
        detection = detector.detect(Frame(np.rint(frame).astype(np.int16), n, n * 8_000_000, 0))
        if detection.outcome is Outcome.TOUCHED:
            detection = detector.clean(detection)
        if n >= 700:
            told.append((detection.outcome is Outcome.TOUCHED) == touches)
        if detection.outcome is not Outcome.LEARNING:
            detector.adapt(detection, touches and detection.outcome is Outcome.TOUCHED, False, False)
    assert told.count(False) <= 1
    assert 0.8 * SIGMA < detector.noise_counts() < 1.1 * SIGMA
