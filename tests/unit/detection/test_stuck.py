"""A frame that equals an earlier one is found, and so is a channel that repeats itself; noise never does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchd.detection.detector import KEEP_EVERY
from touchd.detection.stuck import LASTING_FRAMES, LONGEST_CYCLE, Stuck

SHAPE = (4, 250)
PLATE = 5000 * np.random.default_rng(0).standard_normal(SHAPE)


class Bench:
    """Shows frames one after the other, and keeps each change of the stuck channels."""

    def __init__(self, shape: tuple[int, int] = SHAPE, *, touched: bool = True) -> None:
        self.touched, self.number = touched, 0
        self.seen = np.zeros(shape, np.float32)
        self.changes: list[list[int]] = []
        self.stuck = Stuck(shape)

    def see(self, counts: np.ndarray) -> bool:
        before = self.stuck.live
        self.number += 1
        if not self.number % (LONGEST_CYCLE if self.touched else KEEP_EVERY):
            self.stuck.keep(self.seen)
        elif self.touched:
            self.stuck.turn(self.seen)
        repeats = self.stuck.repeats(counts.astype(np.int16), self.seen)
        if not repeats:
            self.seen[:] = counts.astype(np.int16)
        if self.stuck.live is not before:
            self.changes.append(np.flatnonzero(~self.stuck.live).tolist())
        return repeats


def noisy(rng: np.random.Generator, noise: float = 5.0) -> np.ndarray:
    return np.asarray(np.rint(PLATE + noise * rng.standard_normal(SHAPE)))


@given(noise=st.floats(0.05, 3000), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_noise(noise: float, seed: int) -> None:
    """Noise of any strength never counts as a repetition."""
    bench, rng = Bench(), np.random.default_rng(seed)
    assert not any(bench.see(noisy(rng, noise)) for _ in range(100))
    assert bench.changes == []


@given(first=st.integers(1, 40), count=st.integers(1, 20), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_repetition(first: int, count: int, seed: int) -> None:
    """Every repetition of a frame is found, until the first other frame."""
    bench, rng = Bench(), np.random.default_rng(seed)
    for _ in range(first):
        last = noisy(rng)
        assert not bench.see(last)
    for _ in range(count):
        assert bench.see(last)
        assert bench.stuck.period in (0, 1)
    assert not bench.see(noisy(rng))
    assert bench.stuck.period == 0
    assert bench.changes == [], "what all channels do no channel does alone"


@given(length=st.integers(2, 8), first=st.integers(0, 20), noise=st.floats(0.3, 30), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_cycle(length: int, first: int, noise: float, seed: int) -> None:
    """Frames that come again in a cycle are doubted within 8 frames, 16 if untouched, and found two rounds later."""
    for touched, within in ((True, LONGEST_CYCLE), (False, KEEP_EVERY)):
        bench, rng = Bench(touched=touched), np.random.default_rng(seed)
        assert not any(bench.see(noisy(rng, noise)) for _ in range(first))
        frames = [noisy(rng, noise) for _ in range(length)]
        assert not any(bench.see(frame) for frame in frames)
        found = [bench.see(frame) or bench.stuck.doubtful for frame in frames * 12]
        assert all(found[within:])
        assert all(bench.see(frame) for frame in frames)
        assert bench.stuck.period == length
        after = [bench.see(noisy(rng, noise)) for _ in range(20)]
        assert not any(after[length:])
        assert bench.stuck.period == 0


def test_one_sample() -> None:
    """A frame in which any one sample differs by one count is another frame."""
    for sample in range(0, 1000, 7):
        bench = Bench()
        bench.see(np.rint(PLATE))
        other = np.rint(PLATE)
        other.flat[sample] += 1
        assert not bench.see(other)
        assert bench.see(other)


@pytest.mark.parametrize("channel", range(4))
@pytest.mark.parametrize("value", [None, 0, 32767])
def test_stuck_channel(channel: int, value: int | None) -> None:
    """A channel that repeats itself is reported once, and so is its end."""
    bench, rng = Bench(), np.random.default_rng(channel)
    for _ in range(20):
        last = noisy(rng)
        bench.see(last)
    held = last[channel] if value is None else np.full(SHAPE[1], value)
    for _ in range(SHAPE[0] + LASTING_FRAMES):
        frame = noisy(rng)
        frame[channel] = held
        assert not bench.see(frame)
    assert bench.changes == [[channel]], "after it was watched"
    for _ in range(50):
        frame = noisy(rng)
        frame[channel] = held
        assert not bench.see(frame)
    assert bench.changes == [[channel]]
    bench.see(noisy(rng))
    assert bench.changes == [[channel], []]


def test_frame_with_a_stuck_channel() -> None:
    """A frame with a stuck channel repeats only if all channels do."""
    bench, rng = Bench(), np.random.default_rng(3)
    for _ in range(20):
        frame = noisy(rng)
        frame[2] = 0
        assert not bench.see(frame)
    assert bench.changes == [[2]]
    assert bench.see(frame)
    frame = noisy(rng)
    frame[2] = 0
    assert not bench.see(frame)
    assert bench.changes == [[2]], "it was stuck all the time"


@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (2, 1), (3, 5)])
def test_any_shape(shape: tuple[int, int]) -> None:
    """Frames of any shape are compared."""
    bench = Bench(shape)
    ones = np.ones(shape)
    assert [bench.see(ones), bench.see(ones), bench.see(2 * ones), bench.see(2 * ones)] == [False, True, False, True]
