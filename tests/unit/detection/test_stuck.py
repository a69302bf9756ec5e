"""A frame that is the one before is found out, and so is a channel; noise never is, however little of it there is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchd.detection.stuck import LASTING_FRAMES, Frozen

SHAPE = (4, 250)
PLATE = 5000 * np.random.default_rng(0).standard_normal(SHAPE)


class Bench:
    """Frames looked at one after the other, each taken in unless it was the one before."""

    def __init__(self, shape: tuple[int, int] = SHAPE) -> None:
        self.seen = np.zeros(shape, np.float32)
        self.told: list[list[int]] = []
        self.frozen = Frozen(self.seen, lambda channels: self.told.append(np.flatnonzero(channels).tolist()))

    def see(self, counts: np.ndarray) -> bool:
        self.frozen.turn()
        repeats = self.frozen.repeats(counts.astype(np.int16))
        if not repeats:
            self.seen[:] = counts.astype(np.int16)
        return repeats


def noisy(rng: np.random.Generator, noise: float = 5.0) -> np.ndarray:
    return np.asarray(np.rint(PLATE + noise * rng.standard_normal(SHAPE)))


@given(noise=st.floats(0.05, 3000), seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=30)
def test_noise_is_never_taken_for_a_repetition(noise: float, seed: int) -> None:
    bench, rng = Bench(), np.random.default_rng(seed)
    assert not any(bench.see(noisy(rng, noise)) for _ in range(100))
    assert bench.told == []


@given(first=st.integers(1, 40), count=st.integers(1, 20), seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=30)
def test_every_repetition_of_a_frame_is_found_and_it_ends_with_the_first_other_frame(
    first: int, count: int, seed: int
) -> None:
    bench, rng = Bench(), np.random.default_rng(seed)
    for _ in range(first):
        last = noisy(rng)
        assert not bench.see(last)
    for repeated in range(1, count + 1):
        assert bench.see(last)
        assert bench.frozen.frames == repeated
    assert not bench.see(noisy(rng))
    assert bench.frozen.frames == 0
    assert bench.told == [], "what all channels do no channel does alone"


def test_a_sample_that_changes_by_one_count_makes_another_frame() -> None:
    """Wherever it is, also where nothing but a comparison of all would see it."""
    for place in range(0, 1000, 7):
        bench = Bench()
        bench.see(np.rint(PLATE))
        other = np.rint(PLATE)
        other.flat[place] += 1
        assert not bench.see(other)
        assert bench.see(other)


@pytest.mark.parametrize("channel", range(4))
@pytest.mark.parametrize("value", [None, 0, 32767])
def test_a_channel_that_repeats_itself_is_told_once_and_so_is_its_end(channel: int, value: int | None) -> None:
    bench, rng = Bench(), np.random.default_rng(channel)
    for _ in range(20):
        last = noisy(rng)
        bench.see(last)
    held = last[channel] if value is None else np.full(SHAPE[1], value)
    for _ in range(SHAPE[0] + LASTING_FRAMES):
        frame = noisy(rng)
        frame[channel] = held
        assert not bench.see(frame)
    assert bench.told == [[channel]], "as soon as it was looked at, and stayed the same"
    for _ in range(50):
        frame = noisy(rng)
        frame[channel] = held
        assert not bench.see(frame)
    assert bench.told == [[channel]]
    bench.see(noisy(rng))
    assert bench.told == [[channel], []]


def test_a_frame_with_a_frozen_channel_repeats_only_if_all_channels_do() -> None:
    bench, rng = Bench(), np.random.default_rng(3)
    for _ in range(20):
        frame = noisy(rng)
        frame[2] = 0
        assert not bench.see(frame)
    assert bench.told == [[2]]
    assert bench.see(frame)
    frame = noisy(rng)
    frame[2] = 0
    assert not bench.see(frame)
    assert bench.told == [[2]], "it was frozen all the time"


@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (2, 1), (3, 5)])
def test_frames_of_any_shape_are_compared(shape: tuple[int, int]) -> None:
    bench = Bench(shape)
    ones = np.ones(shape)
    assert [bench.see(ones), bench.see(ones), bench.see(2 * ones), bench.see(2 * ones)] == [False, True, False, True]
