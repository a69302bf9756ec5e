"""A tone is found by what it leaves in few bins; what is loud in all bins is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchd.localization.tones import WATCHED_NS, Tones

CHANNELS, BINS = 4, 34
SIZE = CHANNELS * 2 * BINS
NOISE_POWER = np.ones(SIZE, np.float32)
PERIOD_NS = 32_000_000


def listen(tones: Tones, loud: np.ndarray, rng: np.random.Generator, *, end_ns: int = WATCHED_NS) -> list[bool]:
    """Show a second of noise with this much more in each value, of a phase that creeps."""
    changes = []
    for t_ns in range(0, end_ns + PERIOD_NS, PERIOD_NS):
        vector = rng.standard_normal(SIZE) + loud * np.cos(t_ns * 1e-9)
        changes.append(tones.update(vector.astype(np.float32), NOISE_POWER, t_ns))
    return changes


@pytest.fixture
def tones() -> Tones:
    return Tones(CHANNELS, BINS)


@given(first=st.integers(0, BINS - 7), width=st.integers(1, 7), level=st.floats(30, 3000), seed=st.integers(0, 99))
@settings(deadline=None, max_examples=30)
def test_tone(first: int, width: int, level: float, seed: int) -> None:
    """After a second the bins of a tone are left out, of both parts and all channels, and only they."""
    tones, loud = Tones(CHANNELS, BINS), np.zeros((CHANNELS, 2, BINS))
    loud[:, :, first : first + width] = level
    changes = listen(tones, loud.reshape(-1), np.random.default_rng(seed))
    assert changes == [False] * (len(changes) - 1) + [True]
    assert tones.quiet is not None
    np.testing.assert_array_equal(tones.quiet, loud.reshape(-1) == 0)


@given(level=st.floats(3, 3000), seed=st.integers(0, 99))
@settings(deadline=None, max_examples=30)
def test_no_tone(level: float, seed: int) -> None:
    """Of what is spread over all bins none is left out, though some hold far more than others."""
    tones, rng = Tones(CHANNELS, BINS), np.random.default_rng(seed)
    assert not any(listen(tones, level * rng.standard_normal(SIZE), rng))
    assert tones.quiet is None


def test_noise(tones: Tones) -> None:
    """Noise as it was is no tone."""
    assert not any(listen(tones, np.zeros(SIZE), np.random.default_rng(1)))


def test_restart(tones: Tones) -> None:
    """A finger within the second has it begin again, and what was known stays known until the plate is untouched."""
    loud, rng = np.zeros((CHANNELS, 2, BINS)), np.random.default_rng(1)
    loud[:, :, 5:9] = 100
    assert not any(listen(tones, loud.reshape(-1), rng, end_ns=WATCHED_NS // 2))
    tones.restart()
    assert any(listen(tones, loud.reshape(-1), rng))
    tones.restart()
    assert not any(listen(tones, loud.reshape(-1), rng)), "it is known"
    assert tones.quiet is not None
    tones.reset()
    assert tones.quiet is None
