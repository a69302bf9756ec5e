"""A frame that differs from the one kept by no more than noise holds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.config.schema import GateSettings
from touchd.detection.gate import Gate
from touchd.localization.stillness import StillFrame

SHAPE = (4, 250)
RATE = 0.01
FINGER = np.random.default_rng(7).standard_normal(SHAPE) * 100


def noise(rng: np.random.Generator, frames: int, coloured: bool = False) -> np.ndarray:
    """Residuals of shape (frames, 4, 250): white, or two thirds of their energy of one shape, as trigger jitter is."""
    white = rng.standard_normal((frames, *SHAPE))
    if coloured:
        slope = np.random.default_rng(5).standard_normal(SHAPE)
        white += rng.standard_normal((frames, 1, 1)) * slope * np.sqrt(2)
    return white.astype(np.float32)


def gate_of(rng: np.random.Generator, *, coloured: bool = False) -> Gate:
    """A gate that has seen a thousand untouched frames."""
    gate = Gate(GateSettings())
    gate.learn(np.sum(noise(rng, 1000, coloured).astype(np.float64) ** 2, axis=(1, 2)))
    return gate


def keep(still: StillFrame, frame: np.ndarray, gate: Gate) -> None:
    still.update(frame, (gate.noise_root + still.quantile * gate.noise_deviation) ** 3)


@pytest.mark.parametrize(("coloured", "times"), [(False, 1.5), (True, 4.0)])
@pytest.mark.parametrize("rate", [0.1, 0.01])
def test_rate(coloured: bool, times: float, rate: float) -> None:
    """A finger that rests is located again at the stated rate, in white noise; in coloured noise at four times it."""
    rng = np.random.default_rng(1)
    still, gate = StillFrame(SHAPE, rate), gate_of(rng, coloured=coloured)
    frames = noise(rng, 20_000 if rate < 0.1 else 1000, coloured) + FINGER.astype(np.float32)
    looks = 0
    for frame in frames:
        if not still.holds(frame):
            looks += 1
            keep(still, frame, gate)
    print(f"{looks / len(frames):.4f} of the frames instead of {rate}")
    # Where one shape has most of the noise, the cube root of its energy is no longer normal.
    assert rate / 2 < looks / len(frames) < times * rate


def test_creeping_finger() -> None:
    """A finger that creeps is located again once it has come farther than the noise."""
    rng = np.random.default_rng(2)
    still, gate = StillFrame(SHAPE, RATE), gate_of(rng)
    frames = noise(rng, 400)
    direction = FINGER / np.linalg.norm(FINGER)
    keep(still, frames[0], gate)
    held = [still.holds((frame + direction * 0.1 * i).astype(np.float32)) for i, frame in enumerate(frames)]
    assert np.mean(held[:30]) > 0.9
    # Two frames differ by 2 x 1000 +- 90; 30 units farther along one direction are 900 more.
    assert not any(held[300:])


@given(st.floats(0.5, 100), st.integers(0, 2**32 - 1))
def test_any_gain(gain: float, seed: int) -> None:
    """The same frame holds at any gain, and another does not."""
    rng = np.random.default_rng(seed)
    gate = Gate(GateSettings())
    gate.learn(gain**2 * np.sum(noise(rng, 50).astype(np.float64) ** 2, axis=(1, 2)))
    still = StillFrame(SHAPE, RATE)
    here, there = (
        np.float32(gain) * (noise(rng, 1)[0] + np.float32(sign) * FINGER).astype(np.float32) for sign in (1, -1)
    )
    assert not still.holds(here), "no frame was kept yet"
    keep(still, here, gate)
    assert still.holds(here)
    assert not still.holds(there)
    still.reset()
    assert not still.holds(here)


def test_nan() -> None:
    """A frame of NaN has changed."""
    still = StillFrame(SHAPE, RATE)
    keep(still, np.zeros(SHAPE, np.float32), gate_of(np.random.default_rng(3)))
    assert not still.holds(np.full(SHAPE, np.nan, np.float32))
