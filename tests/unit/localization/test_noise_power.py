"""What an untouched plate's bins hold: their mean power, and which of them drown in a tone."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from touchd.localization.noise_power import MEMORY_FRAMES, Noise

CHANNELS, BINS = 4, 15


def heard(frames: np.ndarray) -> Noise:
    noise = Noise(CHANNELS, BINS)
    for features in frames.astype(np.float32):
        noise.hear(features)
    return noise


@given(st.integers(1, MEMORY_FRAMES), st.floats(1e-3, 1e4), st.integers(0, 2**32 - 1))
def test_the_power_is_the_mean_square_as_in_float64(count: int, size: float, seed: int) -> None:
    frames = size * np.random.default_rng(seed).standard_normal((count, CHANNELS * 2 * BINS))
    np.testing.assert_allclose(heard(frames).power, np.square(frames).mean(axis=0), rtol=1e-4)


def test_it_follows_noise_that_becomes_louder_and_forgets_when_told() -> None:
    frames = np.random.default_rng(1).standard_normal((2000, CHANNELS * 2 * BINS))
    frames[500:] *= 3
    noise = heard(frames)
    assert abs(noise.power.mean() / 9 - 1) < 0.1
    noise.forget()
    assert not noise.power.any()
    noise.hear(frames[0].astype(np.float32))
    np.testing.assert_allclose(noise.power, np.square(frames[0]), rtol=1e-6)


def test_begun_again_it_is_what_it_was_until_it_hears_and_tells_when_it_heard_enough() -> None:
    """A moment without noise would have everything be a finger."""
    frames = np.random.default_rng(2).standard_normal((100, CHANNELS * 2 * BINS)).astype(np.float32)
    noise = heard(10 * frames)
    before = noise.power.copy()
    noise.begin()
    np.testing.assert_array_equal(noise.power, before)
    assert [noise.hear(features) for features in frames[:40]].index(True) == 15
    np.testing.assert_allclose(noise.power, np.square(frames[:40]).mean(axis=0), rtol=1e-4)


@given(st.integers(0, CHANNELS - 1), st.integers(0, BINS - 1), st.integers(0, 100))
def test_a_tone_is_left_out_where_it_is_heard_and_nowhere_else(channel: int, tone_bin: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = rng.standard_normal((64, CHANNELS, 2, BINS))
    phase = rng.uniform(0, 2 * np.pi, 64)
    frames[:, channel, :, tone_bin] += 10 * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    expected = np.ones((CHANNELS, 2, BINS), bool)
    expected[channel, :, tone_bin] = False
    np.testing.assert_array_equal(heard(frames.reshape(64, -1)).quiet(), expected.ravel())


@given(st.integers(0, 40), st.integers(0, 1000))
def test_of_white_noise_nothing_is_left_out_however_little_was_heard(count: int, seed: int) -> None:
    noise = heard(np.random.default_rng(seed).standard_normal((count, CHANNELS * 2 * BINS)))
    assert noise.quiet().all()


def test_silence_leaves_nothing_out() -> None:
    assert heard(np.zeros((40, CHANNELS * 2 * BINS))).quiet().all()
