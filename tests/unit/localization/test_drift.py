"""Temperature, gains and dead channels are known from the untouched plate, and the bins corrected for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fields import BINS, RIG, Field, in_double, make_atlas, untouched
from touchd.localization.drift import FOLLOW_EVERY_NS, FOLLOW_S, Drift
from touchd.localization.features import windowed_dft
from touchd.localization.plate_changes import drive_waves

ATLAS = make_atlas(Field())
PLAIN = windowed_dft(RIG, np.array(BINS))
STRETCH = st.floats(-9e-4, 9e-4)
"""Twenty kelvin on glass."""
GAINS = st.lists(st.floats(0.7, 1.4), min_size=4, max_size=4)


def after(baseline: np.ndarray) -> Drift:
    drift = Drift(ATLAS)
    drift.set_baseline(baseline.astype(np.float32))
    return drift


def corrected(drift: Drift, residual: np.ndarray) -> np.ndarray:
    out = np.zeros(ATLAS.size, np.float32)
    drift.correct(residual.astype(np.float32), out)
    return out


STILL = after(untouched())


@given(STRETCH, st.floats(-1e-7, 1e-7), GAINS)
@settings(max_examples=30)
def test_stretch_and_gains(stretch: float, delay_s: float, gains: list[float]) -> None:
    """Stretch and gains are recovered at any delay, the stretch within a tenth, as the operator is.

    The delay turns the gains along the band: the second order of a tenth of a microsecond, 1e-3, looks like a stretch
    of 6e-6, and that of twenty kelvin like gains that tilt by 2 %.
    """
    drift = after(np.array(gains)[:, None] * untouched(stretch, delay_s))
    assert drift.stretch == pytest.approx(stretch, rel=0.15, abs=1e-5)
    turns = np.exp(-2j * np.pi * np.array(BINS) * RIG.sample_rate_hz / RIG.samples * delay_s)
    np.testing.assert_allclose((drift.gains / turns).mean(axis=1), gains, rtol=0.02)
    np.testing.assert_allclose(drift.gains, np.array(gains)[:, None] * turns, rtol=0.04)
    assert not drift.dead.any()


@pytest.mark.parametrize("stretch", [-2e-2, -1e-2, -4e-3, 4e-3, 1e-2, 2e-2])
def test_acrylic_on_another_day(stretch: float) -> None:
    """Ten and twenty kelvin on acrylic, far beyond the first order, are known at once; and so is the way back."""
    drift = after(untouched(stretch))
    assert drift.stretch == pytest.approx(stretch, rel=0.05)
    drift.set_baseline(untouched().astype(np.float32))
    assert drift.stretch == pytest.approx(0, abs=1e-9)


@given(
    STRETCH, st.lists(st.floats(-30, 30), min_size=4, max_size=4), st.lists(st.floats(-3, 3), min_size=4, max_size=4)
)
@settings(max_examples=30)
def test_tilts(stretch: float, deg: list[float], db: list[float]) -> None:
    """Phase and gain that tilt along the band are recovered, as of discs whose bonds age, and taken out of bins."""
    hz = np.fft.rfftfreq(RIG.samples, 1 / RIG.sample_rate_hz)
    x = np.clip((hz - np.mean(RIG.chirp.band_hz)) / (np.ptp(RIG.chirp.band_hz) / 2), -1.3, 1.3)
    tilts = np.exp(np.outer(np.log(10) / 20 * np.array(db) + 1j * np.radians(deg), x))

    def tilted(signal: np.ndarray) -> np.ndarray:
        return np.fft.irfft(np.fft.rfft(signal) * tilts, RIG.samples)

    drift = after(tilted(untouched(stretch)))
    assert np.sqrt(np.mean(np.abs(drift.gains - tilts[:, BINS]) ** 2)) < 0.06
    original = (untouched(0.0, seed=3) @ PLAIN).ravel()
    seen = tilted(untouched(stretch, seed=3))
    changed = np.linalg.norm((seen @ PLAIN).ravel() - original)
    assert np.linalg.norm(corrected(drift, seen) - original) < 0.35 * changed + 0.02 * np.linalg.norm(original)


@given(STRETCH, GAINS, st.integers(0, 50), st.floats(0.0, 1.0))
@settings(max_examples=30)
def test_cables_that_were_moved(stretch: float, gains: list[float], seed: int, level: float) -> None:
    """The drive in the channels, as loud as the plate, changes neither stretch nor gains."""
    mixed = np.random.default_rng(seed).standard_normal((4, 4)) @ drive_waves(RIG)
    plate = np.array(gains)[:, None] * untouched(stretch)
    scale = level * np.linalg.norm(plate, axis=1) / np.linalg.norm(mixed, axis=1)
    drift = after(plate + scale[:, None] * mixed)
    assert drift.stretch == pytest.approx(stretch, rel=0.15, abs=1e-5)
    np.testing.assert_allclose(drift.gains.mean(axis=1), gains, rtol=0.02)
    np.testing.assert_allclose(drift.gains, np.tile(gains, (len(BINS), 1)).T, rtol=0.04)


def test_a_disc_that_came_off() -> None:
    """A channel that hears the drive alone is dead, and falls silent likewise."""
    there = untouched() + 300 * drive_waves(RIG)[0]
    drift = Drift(replace(ATLAS, baseline=there.astype(np.float32)))
    drift.set_baseline(there.astype(np.float32))
    off = there.copy()
    off[2] = 300 * drive_waves(RIG)[0]
    assert not drift.dead.any()
    assert drift.silent((off - there).astype(np.float32), there.astype(np.float32)).tolist() == [0, 0, 1, 0]
    drift.set_baseline(off.astype(np.float32))
    assert drift.dead.tolist() == [False, False, True, False]


def test_plate_of_the_training() -> None:
    """The plate of the training is left as it is; with a float64 atlas to its rounding."""
    drift = after(untouched())
    assert drift.stretch == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(drift.gains, 1, atol=1e-5)
    residual = np.random.default_rng(1).standard_normal(RIG.shape)
    np.testing.assert_allclose(corrected(drift, residual), (residual @ PLAIN).ravel(), atol=1e-3)
    double, out = Drift(in_double(ATLAS)), np.zeros(ATLAS.size)
    double.set_baseline(ATLAS.baseline.astype(np.float64))
    double.correct(residual, out)
    np.testing.assert_allclose(out, (residual @ PLAIN).ravel(), atol=1e-9)


@given(STRETCH, GAINS, st.integers(2, 50))
@settings(max_examples=30)
def test_correction(stretch: float, gains: list[float], seed: int) -> None:
    """A correction leaves a quarter of what the stretch has changed, and nothing of the gains."""
    amplified = np.array(gains)[:, None]
    drift = after(amplified * untouched(stretch))
    original = (untouched(0.0, seed=seed) @ PLAIN).ravel()
    stretched = untouched(stretch, seed=seed)
    changed = np.linalg.norm((stretched @ PLAIN).ravel() - original)
    left = np.linalg.norm(corrected(drift, amplified * stretched) - original)
    assert left < 0.35 * changed + 0.02 * np.linalg.norm(original)


def test_plate_directions() -> None:
    """A steady change along stretch, delay, gains and what channels hear of the drive is followed; across it nothing.

    Also where channels have other gains than in training.
    """
    amplified = np.array([1.2, 0.8, 1.1, 1.0])[:, None]
    drift = after(amplified * untouched())
    gain = amplified * (1 + np.array([0.01, -0.02, 0.015, 0.005])[:, None])
    mixed = np.random.default_rng(3).standard_normal((4, 4)) @ drive_waves(RIG)
    drifted = gain * untouched(2e-5, 1e-9) - amplified * untouched() + 20 * mixed
    before = np.linalg.norm(corrected(drift, drifted))
    for i in range(round(5 * FOLLOW_S / 0.04)):
        drift.update(corrected(drift, drifted), i * 40_000_000)
    assert np.linalg.norm(corrected(drift, drifted)) < 0.1 * before
    drift.reset()
    assert np.linalg.norm(corrected(drift, drifted)) == pytest.approx(before, rel=1e-6)
    noise = np.random.default_rng(2).standard_normal(RIG.shape) * 10
    first = corrected(drift, noise)
    for i in range(100):
        drift.update(corrected(drift, noise), i * 40_000_000)
    across = corrected(drift, noise)
    assert np.linalg.norm(across) > 0.85 * np.linalg.norm(first), "22 of 120 directions"
    drift.reset()
    for t_ns in (0, 10_000_000_000):
        drift.update(across, t_ns)
    np.testing.assert_allclose(corrected(drift, noise), first, atol=1e-3 * np.abs(first).max())


@given(st.lists(st.integers(1, 2_000_000_000), min_size=1, max_size=20))
@settings(max_examples=30)
def test_time_constant(steps_ns: list[int]) -> None:
    """After t seconds of updates at any times, a steady change is followed but for exp(-t / 0.3 s)."""
    drift, drifted, t_ns = STILL, 0.01 * untouched(), 10**15
    drift.reset()
    before = float(np.linalg.norm(corrected(drift, drifted)))
    drift.update(corrected(drift, drifted), t_ns)
    for step_ns in steps_ns:
        t_ns += step_ns
        drift.update(corrected(drift, drifted), t_ns)
    share = float(np.linalg.norm(corrected(drift, drifted))) / before
    assert share == pytest.approx(np.exp(-sum(steps_ns) * 1e-9 / FOLLOW_S), abs=1e-4)


def test_due() -> None:
    """An update is due 40 ms after the first frame and each update, and if the clock steps back: that moves nothing."""
    drift, drifted = after(untouched()), 0.01 * untouched()
    assert not drift.is_due(10**12 - FOLLOW_EVERY_NS - 1), "in no time nothing drifts"
    assert drift.is_due(10**12)
    drift.update(corrected(drift, drifted), 10**12)
    assert not drift.is_due(10**12 + FOLLOW_EVERY_NS)
    assert drift.is_due(10**12 + FOLLOW_EVERY_NS + 1)
    assert drift.is_due(10**12 - 1)
    before = corrected(drift, drifted)
    drift.update(before, 10**12 - 3_600_000_000_000)
    np.testing.assert_array_equal(corrected(drift, drifted), before)
    assert not drift.is_due(10**12 - 3_600_000_000_000 + 1), "it goes on at the new time"


@given(st.integers(0, 3), STRETCH)
@settings(max_examples=30)
def test_dead_channel(dead: int, stretch: float) -> None:
    """A dead channel is found, and the others show the stretch."""
    gains = np.where(np.arange(4) == dead, 1e-3, 1.0)
    drift = after(gains[:, None] * untouched(stretch))
    np.testing.assert_array_equal(drift.dead, np.arange(4) == dead)
    assert drift.stretch == pytest.approx(stretch, rel=0.15, abs=5e-6)
    assert (drift.gains[dead] == 1.0).all()


def test_silent_channel() -> None:
    """A channel that falls silent in a frame is found."""
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
def test_no_temperature(baseline: np.ndarray) -> None:
    """A baseline that no temperature explains leaves the frame alone."""
    drift = after(baseline)
    assert abs(drift.stretch) < 3e-3
    residual = np.random.default_rng(3).standard_normal(RIG.shape)
    found = corrected(drift, residual)
    for t_ns in (0, 40_000_000):
        drift.update(found, t_ns)
    assert np.isfinite(corrected(drift, residual)).all()
    if (drift.gains == 1).all():
        np.testing.assert_allclose(found, (residual @ PLAIN).ravel(), atol=1e-3)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-20, 1e-3, 1.0, 32768.0]), st.integers(-(10**12), 10**12))
def test_any_numbers(seed: int, size: float, elapsed_ns: int) -> None:
    """Stretch, gains and bins are finite, for any baseline, residual and time."""
    rng = np.random.default_rng(seed)
    drift = after(size * rng.uniform(-1, 1, RIG.shape) * rng.integers(0, 2, (4, 1)))
    assert np.isfinite(drift.stretch)
    assert np.isfinite(drift.gains).all()
    residual = size * rng.uniform(-1, 1, RIG.shape)
    for t_ns in (0, elapsed_ns):
        drift.update(corrected(drift, residual), t_ns)
    assert np.isfinite(corrected(drift, residual)).all()


@pytest.mark.parametrize("rate_hz", [10, 50, 125, 250, 500])
def test_any_rate(rate_hz: int) -> None:
    """A step of the plate under a finger is followed to 63 % in 0.3 s and an update at any frame rate."""
    drift = after(untouched())
    step, nothing, time_s, left = 10 * drift.directions[0], np.zeros(untouched().shape), 0.0, 1.0
    while left > np.exp(-1) * 1.001:
        if drift.is_due(t_ns := 10**9 + round(time_s * 1e9)):
            drift.update(step + corrected(drift, nothing), t_ns)
        left = float((step + corrected(drift, nothing)) @ step / (step @ step))
        time_s += 1 / rate_hz
    reached_s = time_s - 1 / rate_hz
    assert FOLLOW_S - 1e-6 <= reached_s <= FOLLOW_S + FOLLOW_EVERY_NS * 1e-9 + 1 / rate_hz
