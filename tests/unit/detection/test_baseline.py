"""The baseline: learned from a steady plate, followed as it drifts."""

import numpy as np
import pytest

from touchd.config.schema import BaselineSettings
from touchd.detection.baseline import Baseline

SHAPE = (4, 250)
SETTINGS = BaselineSettings()
PERIOD_S = 0.008


def signal(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(SHAPE) * 5000


def noisy(mean: np.ndarray, rng: np.random.Generator, noise: float = 10.0) -> np.ndarray:
    return np.rint(mean + noise * rng.standard_normal(SHAPE)).astype(np.int16)


def learn(baseline: Baseline, frames: list[np.ndarray]) -> int | None:
    """The number of frames it took, or None."""
    for number, counts in enumerate(frames, 1):
        if baseline.learn(counts) is not None:
            return number
    return None


def test_a_steady_plate_is_learned_from_its_first_32_frames() -> None:
    rng = np.random.default_rng(1)
    baseline = Baseline(SHAPE, SETTINGS)
    mean = signal()
    assert learn(baseline, [noisy(mean, rng) for _ in range(100)]) == 32
    assert np.sqrt(np.mean((baseline.mean - mean) ** 2)) == pytest.approx(10 / np.sqrt(32), rel=0.1)


def test_the_energies_learned_are_those_of_later_frames() -> None:
    """Frames differ less from a mean they were part of; the gate must not be told so."""
    rng = np.random.default_rng(2)
    baseline = Baseline(SHAPE, SETTINGS)
    mean = signal()
    for _ in range(31):
        assert baseline.learn(noisy(mean, rng)) is None
    energies = baseline.learn(noisy(mean, rng))
    assert energies is not None
    later = [baseline.subtract(noisy(mean, rng)) for _ in range(200)]
    assert energies.mean() == pytest.approx(np.mean(later), rel=0.05)


def test_a_plate_touched_while_it_is_learned_is_learned_once_it_is_still() -> None:
    rng = np.random.default_rng(3)
    baseline = Baseline(SHAPE, SETTINGS)
    mean, touch = signal(), signal(1) * 0.03
    frames = [noisy(mean + touch * (10 <= i < 40), rng) for i in range(200)]
    taken = learn(baseline, frames)
    assert taken is not None
    assert taken > 40
    assert np.abs(baseline.mean - mean).max() < 10


def test_a_plate_that_never_gets_still_is_learned_all_the_same() -> None:
    rng = np.random.default_rng(4)
    baseline = Baseline(SHAPE, SETTINGS)
    mean = signal()
    frames = [noisy(mean * (1 + 1e-3 * i), rng) for i in range(2000)]
    assert learn(baseline, frames) is not None


def test_the_baseline_follows_with_its_time_constant() -> None:
    rng = np.random.default_rng(5)
    baseline = Baseline(SHAPE, SETTINGS)
    mean = signal()
    learn(baseline, [noisy(mean, rng) for _ in range(32)])
    step = 100.0
    for _ in range(round(SETTINGS.time_constant_s / PERIOD_S)):
        baseline.subtract(noisy(mean + step, rng))
        baseline.follow(PERIOD_S)
    assert float((baseline.mean - mean).mean()) == pytest.approx(step * (1 - np.exp(-1)), rel=0.05)


def test_the_residual_of_full_scale_frames_does_not_wrap() -> None:
    baseline = Baseline(SHAPE, SETTINGS)
    learn(baseline, [np.full(SHAPE, -32768, np.int16)] * 32)
    energy = baseline.subtract(np.full(SHAPE, 32767, np.int16))
    assert (baseline.residual == 65535).all()
    assert energy == pytest.approx(65535.0**2 * 1000, rel=1e-5)


def test_subtracting_is_the_arithmetic_of_training_bit_for_bit() -> None:
    from touchd.evaluation.dataset import residual_of

    rng = np.random.default_rng(6)
    baseline = Baseline(SHAPE, SETTINGS)
    learn(baseline, [noisy(signal(), rng) for _ in range(32)])
    counts = noisy(signal(), rng)
    baseline.subtract(counts)
    assert (baseline.residual == residual_of(counts, baseline.mean)).all()
