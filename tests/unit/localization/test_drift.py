"""What warmth, gains and dead channels do to a frame is known from the untouched plate, and taken off."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fields import BINS, RIG, Field, make_atlas, untouched
from touchd.localization.drift import FOLLOW_S, Drift
from touchd.localization.features import windowed_dft

ATLAS = make_atlas(Field())
PLAIN = windowed_dft(RIG, np.array(BINS))
STRETCH = st.floats(-9e-4, 9e-4)
"""Twenty kelvin on glass."""
GAINS = st.lists(st.floats(0.7, 1.4), min_size=4, max_size=4)


def after(baseline: np.ndarray) -> Drift:
    drift = Drift(ATLAS)
    drift.rebase(baseline.astype(np.float32))
    return drift


def features(drift: Drift, residual: np.ndarray) -> np.ndarray:
    out = np.zeros(ATLAS.size, np.float32)
    drift.features(residual.astype(np.float32), out)
    return out


@given(STRETCH, st.floats(-1e-7, 1e-7), GAINS)
@settings(deadline=None)
def test_stretch_and_gains_are_recovered_whatever_the_delay(stretch: float, delay_s: float, gains: list[float]) -> None:
    """The stretch within a tenth, as the operator is; what it misses of the plate is seen as gain, a little.

    The delay is fitted in its first order: the second of a tenth of a microsecond, 1e-3, looks like a stretch of 6e-6.
    """
    drift = after(np.array(gains)[:, None] * untouched(stretch, delay_s))
    assert drift.stretch == pytest.approx(stretch, rel=0.15, abs=1e-5)
    np.testing.assert_allclose(drift.gains, gains, rtol=0.02)
    assert not drift.dead.any()


def test_the_plate_of_the_training_is_left_as_it_is() -> None:
    drift = after(untouched())
    assert drift.stretch == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(drift.gains, 1, atol=1e-5)
    residual = np.random.default_rng(1).standard_normal(RIG.shape)
    np.testing.assert_allclose(features(drift, residual), (residual @ PLAIN).ravel(), atol=1e-3)


@given(STRETCH, GAINS, st.integers(2, 50))
@settings(deadline=None)
def test_of_a_stretched_and_amplified_residual_the_features_are_those_of_the_training(
    stretch: float, gains: list[float], seed: int
) -> None:
    """To first order: a quarter of what the stretch has changed is left, and nothing of the gains."""
    amplified = np.array(gains)[:, None]
    drift = after(amplified * untouched(stretch))
    original = (untouched(0.0, seed=seed) @ PLAIN).ravel()
    stretched = untouched(stretch, seed=seed)
    changed = np.linalg.norm((stretched @ PLAIN).ravel() - original)
    left = np.linalg.norm(features(drift, amplified * stretched) - original)
    assert left < 0.35 * changed + 0.02 * np.linalg.norm(original)


def test_what_the_plate_can_do_by_itself_vanishes_and_the_rest_stays() -> None:
    """Along stretch, delay and gains a steady change is followed with the time constant; across them nothing is."""
    drift = after(untouched())
    rng = np.random.default_rng(2)
    gain = np.array([0.01, -0.02, 0.015, 0.005])[:, None]
    drifted = untouched(2e-5, 1e-9) * (1 + gain) - untouched()
    before = np.linalg.norm(features(drift, drifted))
    step_s = 0.04
    for _ in range(round(5 * FOLLOW_S / step_s)):
        drift.follow(features(drift, drifted), step_s)
    assert np.linalg.norm(features(drift, drifted)) < 0.1 * before
    drift.settle()
    assert np.linalg.norm(features(drift, drifted)) == pytest.approx(before, rel=1e-6)
    # A residual across all directions: what of noise remains after following for long.
    noise = rng.standard_normal(RIG.shape) * 10
    first = features(drift, noise)
    for _ in range(100):
        drift.follow(features(drift, noise), step_s)
    across = features(drift, noise)
    assert np.linalg.norm(across) > 0.9 * np.linalg.norm(first), "six of 120 directions"
    drift.settle()
    drift.follow(across, 10.0)
    np.testing.assert_allclose(features(drift, noise), first, atol=1e-3 * np.abs(first).max())


@given(st.integers(0, 3), STRETCH)
@settings(deadline=None, max_examples=30)
def test_a_dead_channel_is_seen_and_the_others_tell_the_stretch(dead: int, stretch: float) -> None:
    gains = np.where(np.arange(4) == dead, 1e-3, 1.0)
    drift = after(gains[:, None] * untouched(stretch))
    np.testing.assert_array_equal(drift.dead, np.arange(4) == dead)
    assert drift.stretch == pytest.approx(stretch, rel=0.15, abs=5e-6)
    assert drift.gains[dead] == 1.0


def test_a_channel_that_falls_silent_in_a_frame_is_seen() -> None:
    drift, baseline = after(untouched()), untouched().astype(np.float32)
    residual = np.zeros(RIG.shape, np.float32)
    assert not drift.silent(residual, baseline).any()
    residual[2] = -baseline[2]
    np.testing.assert_array_equal(drift.silent(residual, baseline), [False, False, True, False])


@pytest.mark.parametrize(
    "baseline",
    [np.zeros(RIG.shape), np.full(RIG.shape, 32767.0), np.full(RIG.shape, 1e-20), -untouched(), untouched(seed=9)],
    ids=["silence", "constant", "next to nothing", "opposite", "another plate"],
)
def test_what_no_warmth_explains_leaves_the_frame_alone(baseline: np.ndarray) -> None:
    drift = after(baseline)
    assert abs(drift.stretch) < 3e-3
    residual = np.random.default_rng(3).standard_normal(RIG.shape)
    found = features(drift, residual)
    drift.follow(found, 0.04)
    assert np.isfinite(features(drift, residual)).all()
    if (drift.gains == 1).all():
        np.testing.assert_allclose(found, (residual @ PLAIN).ravel(), atol=1e-3)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-20, 1e-3, 1.0, 32768.0]), st.floats(0, 1e3))
@settings(deadline=None, max_examples=50)
def test_nothing_makes_it_say_what_is_no_number(seed: int, size: float, elapsed_s: float) -> None:
    rng = np.random.default_rng(seed)
    drift = after(size * rng.uniform(-1, 1, RIG.shape) * rng.integers(0, 2, (4, 1)))
    assert np.isfinite(drift.stretch)
    assert np.isfinite(drift.gains).all()
    residual = size * rng.uniform(-1, 1, RIG.shape)
    drift.follow(features(drift, residual), elapsed_s)
    assert np.isfinite(features(drift, residual)).all()
