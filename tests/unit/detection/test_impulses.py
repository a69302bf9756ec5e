"""Samples that an impulse has hit are found outside the chirp's band, and blanked; all others stay as they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fields import RIG, Field, untouched
from touchd.config.schema import Settings
from touchd.detection.detector import Detector
from touchd.detection.impulses import MOST, TONE_FRAMES, WIDTH, Impulses
from touchd.frame import ACQUISITIONS, Frame
from touchd.outcome import Outcome

SIGMA = 2.0
FIELD = Field()
FINGER = FIELD.residual([(60.0, 45.0, 0.3 + 0.2j)])
STARTS = st.integers(40, RIG.samples - 45)
"""Where the window of the features is above a fifth: nearer to the ends an impulse does not count."""
VALUES = st.lists(st.sampled_from([-600.0, -300.0, 300.0, 600.0]), min_size=1, max_size=4)
SEEDS = st.integers(0, 999)


def noise(seed: int, n: int | None = None) -> np.ndarray:
    shape = RIG.shape if n is None else (n, *RIG.shape)
    return (SIGMA * np.random.default_rng(seed).standard_normal(shape)).astype(np.float32)


def knowing(dtype: type = np.float32) -> Impulses:
    impulses = Impulses(RIG, dtype)
    impulses.learn(noise(5, 64).astype(dtype))
    return impulses


KNOWING = knowing()


def blank(residual: np.ndarray, impulses: Impulses = KNOWING) -> tuple[int, ...]:
    return impulses.blank(residual, float(np.square(residual, dtype=np.float64).sum()))


def hit(residual: np.ndarray, start: int, values: list[float], seed: int) -> np.ndarray:
    """Add an impulse of these values, with another gain in each channel."""
    gain = np.random.default_rng(seed).uniform(0.5, 1.5, (RIG.channels, 1)).astype(np.float32)
    residual[:, start : start + len(values)] += gain * np.array(values, np.float32)
    return residual


@given(STARTS, VALUES, SEEDS, st.booleans())
@settings(deadline=None, max_examples=60)
def test_found(start: int, values: list[float], seed: int, finger: bool) -> None:
    """Every impulse far above noise is blanked, under a finger too, and no sample outside the runs changes."""
    before = hit(noise(seed) + FINGER * np.float32(finger), start, values, seed)
    after = before.copy()
    runs = blank(after)
    assert 1 <= len(runs) <= MOST
    inside = np.zeros(RIG.samples, bool)
    for first in runs:
        inside[first : first + WIDTH] = True
    assert inside[start : start + len(values)].all()
    np.testing.assert_array_equal(after[:, ~inside], before[:, ~inside])
    assert not after[:, inside].any()
    assert blank(after) == () or finger  # what a finger lacks there is no impulse, but may look like one


@given(SEEDS, st.floats(0, 3))
@settings(deadline=None, max_examples=60)
def test_nothing_to_find(seed: int, strength: float) -> None:
    """Noise and fingers of any strength stay as they are, bit for bit."""
    before = noise(seed) + np.float32(strength) * FINGER
    after = before.copy()
    assert blank(after) == ()
    np.testing.assert_array_equal(after, before)


@given(STARTS, VALUES, SEEDS)
@settings(deadline=None, max_examples=30)
def test_double_precision(start: int, values: list[float], seed: int) -> None:
    """Float64 blanks the hit samples too, in as many runs."""
    residual = hit(noise(seed), start, values, seed)
    single, double = blank(residual.copy()), blank(wide := residual.astype(np.float64), DOUBLE)
    assert len(single) == len(double)
    assert not wide[:, start : start + len(values)].any()  # where a run begins, rounding decides


DOUBLE = knowing(np.float64)


def test_two() -> None:
    """Two impulses in a frame are two runs."""
    residual = hit(hit(noise(1), 60, [500.0, -400.0], 1), 180, [600.0], 2)
    runs = sorted(blank(residual))
    assert len(runs) == 2
    assert runs[0] <= 60 <= runs[0] + WIDTH - 2
    assert runs[1] <= 180 < runs[1] + WIDTH


def test_tone() -> None:
    """A tone outside the band is no impulse: frames stay as they are, and soon they are not searched."""
    impulses = knowing()
    tone = 200 * np.sin(2 * np.pi * 12_300 * np.arange(RIG.samples) / RIG.sample_rate_hz)
    for seed in range(TONE_FRAMES + 3):
        before = (noise(seed) + tone).astype(np.float32)
        after = before.copy()
        assert blank(after, impulses) == ()
        np.testing.assert_array_equal(after, before)
    assert blank(hit(noise(1), 60, [500.0], 1), impulses) == ()  # not searched: it may be the tone's turn
    assert blank(noise(2), impulses) == ()
    assert blank(hit(noise(1), 60, [500.0], 1), impulses) != ()


@pytest.mark.parametrize("samples", [16, 60])
def test_short_frames(samples: int) -> None:
    """Frames that are too short to have a band and samples outside it are left alone."""
    impulses = Impulses(RIG.model_copy(update={"samples": samples}))
    impulses.learn(noise(1, 32)[:, :, :samples].copy())
    residual = noise(1)[:, :samples].copy()
    residual[:, 5] = 1000.0
    assert impulses.blank(residual, 1e6) == () or samples > 16


def counts(seed: int) -> np.ndarray:
    return np.asarray(np.rint(10 * untouched() + noise(seed)), np.int16)


def test_untouched() -> None:
    """An impulse on the untouched plate opens no gate, and neither baseline nor noise learn from it."""
    detector = Detector(RIG, Settings(), lambda *_: None)
    for sequence in range(300):
        frame = counts(sequence)
        if sequence % 10 == 7:  # while the baseline is learned, too
            frame[:, 100:103] += np.int16(3000)
        detection = detector.detect(Frame(frame, sequence, sequence * 8_000_000, 0))
        if sequence > 64:
            detection = detector.clean(detection) if detection.outcome is Outcome.TOUCHED else detection
            assert detection.outcome is Outcome.UNTOUCHED
            assert bool(detection.hits) == (sequence % 10 == 7)
            detector.adapt(detection, False, False, False)
    assert detector.noise_counts() == pytest.approx(SIGMA, rel=0.05)
    assert np.abs(detection.baseline - 10 * untouched()).max() < SIGMA


@pytest.mark.parametrize("name", ["audio-96", "audio-192"])
def test_in_steady_state_a_knock_is_loud_and_nothing_is_blanked(name: str) -> None:
    """A contact has lines alone, and a knock what lies below them: too little to say when it was."""
    a, rng = ACQUISITIONS[name], np.random.default_rng(4)
    noise = rng.standard_normal((40, *a.shape)).astype(np.float32)
    impulses = Impulses(a)
    assert not impulses.learn(noise).any()
    seconds = np.arange(a.samples) / a.sample_rate_hz
    lines = 300 * np.sin(2 * np.pi * (a.chirp.band_hz[0] + 4 * a.sample_rate_hz / a.samples) * seconds)
    touched = (noise[0] + lines).astype(np.float32)
    energy = float(np.square(touched).sum())
    assert impulses.loudness(touched) < impulses.most(energy)
    knocked = touched + (100 * np.exp(-300 * seconds) * np.sin(2 * np.pi * 5300 * seconds)).astype(np.float32)
    before = knocked.copy()
    energy = float(np.square(knocked).sum())
    assert impulses.loudness(knocked) > impulses.most(energy)
    assert impulses.blank(knocked, energy) == ()
    assert impulses.in_vain == 1
    assert np.array_equal(knocked, before)
