"""The noise model: power per bin, mask of dead channels and tones, directions of the plate's own movement."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fields import Field, in_double, make_atlas
from touchd.localization.noise import MEMORY_FRAMES, BinPower, NoiseModel

ATLAS = make_atlas(Field())
NO_DIRECTIONS = np.zeros((0, ATLAS.size), np.float32)
CHANNELS, BINS = 4, 15


def averaged(frames: np.ndarray, dtype: type = np.float32) -> BinPower:
    bin_power = BinPower(CHANNELS, BINS, dtype)
    for features in frames.astype(dtype):
        bin_power.update(features)
    return bin_power


def model_of(
    noise: np.ndarray | float, directions: np.ndarray = NO_DIRECTIONS, dead: tuple[int, ...] = ()
) -> NoiseModel:
    """A model of 200 frames of noise of some deviation, for each value or for all."""
    model, rng = NoiseModel(ATLAS), np.random.default_rng(1)
    for _ in range(200):
        model.update((noise * rng.standard_normal(ATLAS.size)).astype(np.float32))
    model.set_channels(~np.isin(np.arange(4), dead), directions)
    return model


# -- power of each bin -------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "rounding"), [(np.float32, 1e-4), (np.float64, 1e-12)])
@given(count=st.integers(1, MEMORY_FRAMES), size=st.floats(1e-3, 1e4), seed=st.integers(0, 2**32 - 1))
def test_power(dtype: type, rounding: float, count: int, size: float, seed: int) -> None:
    """The power is the mean square of the frames."""
    frames = size * np.random.default_rng(seed).standard_normal((count, CHANNELS * 2 * BINS))
    np.testing.assert_allclose(averaged(frames, dtype).power, np.square(frames).mean(axis=0), rtol=rounding)


def test_louder_noise() -> None:
    """The power follows noise that becomes louder, and `reset` forgets it."""
    frames = np.random.default_rng(1).standard_normal((2000, CHANNELS * 2 * BINS))
    frames[500:] *= 3
    bin_power = averaged(frames)
    assert abs(bin_power.power.mean() / 9 - 1) < 0.1
    bin_power.reset()
    assert not bin_power.power.any()
    bin_power.update(frames[0].astype(np.float32))
    np.testing.assert_allclose(bin_power.power, np.square(frames[0]), rtol=1e-6)


def test_restart() -> None:
    """After `restart` the power stays in use until the next frame, and bins are masked from the 16th on."""
    frames = np.random.default_rng(2).standard_normal((100, CHANNELS * 2 * BINS)).astype(np.float32)
    bin_power = averaged(10 * frames)
    before = bin_power.power.copy()
    bin_power.restart()
    np.testing.assert_array_equal(bin_power.power, before)
    assert [bin_power.update(features) for features in frames[:40]].index(True) == 15
    np.testing.assert_allclose(bin_power.power, np.square(frames[:40]).mean(axis=0), rtol=1e-4)


@given(st.integers(0, CHANNELS - 1), st.integers(0, BINS - 1), st.integers(0, 100))
def test_tone(channel: int, tone_bin: int, seed: int) -> None:
    """A tone masks its bin in its channel, and no other."""
    rng = np.random.default_rng(seed)
    frames = rng.standard_normal((64, CHANNELS, 2, BINS))
    phase = rng.uniform(0, 2 * np.pi, 64)
    frames[:, channel, :, tone_bin] += 10 * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    expected = np.ones((CHANNELS, 2, BINS), bool)
    expected[channel, :, tone_bin] = False
    np.testing.assert_array_equal(averaged(frames.reshape(64, -1)).quiet(), expected.ravel())


@given(st.integers(0, 40), st.integers(0, 1000))
def test_white_noise(count: int, seed: int) -> None:
    """White noise masks no bin, and neither does silence."""
    assert averaged(np.random.default_rng(seed).standard_normal((count, CHANNELS * 2 * BINS))).quiet().all()
    assert averaged(np.zeros((count, CHANNELS * 2 * BINS))).quiet().all()


# -- what is used of a frame -------------------------------------------------------------------------


@given(st.floats(0.1, 100), st.sets(st.integers(0, 3), max_size=3))
@settings(max_examples=20)
def test_noise_energy(deviation: float, dead: set[int]) -> None:
    """Noise energy and variance are those of the channels in use."""
    model = model_of(deviation, dead=tuple(dead))
    assert model.active_bins == ATLAS.size * (4 - len(dead)) // 4
    assert model.noise_energy == pytest.approx(model.active_bins * deviation**2, rel=0.05)
    assert model.variance == pytest.approx(ATLAS.description.noise_scale * deviation**2, rel=0.05)
    assert (model.mask is None) is (not dead)


def test_drowned_bin() -> None:
    """A bin that drowns is left out."""
    noise = np.ones(ATLAS.size)
    parts = [3, 3 + ATLAS.size // 8]  # of a bin of the first channel
    noise[parts] = 10.0
    model = model_of(noise)
    assert model.mask is not None
    assert np.flatnonzero(model.mask == 0).tolist() == parts
    assert model.noise_energy == pytest.approx(ATLAS.size - 2, rel=0.05)


def test_few_shapes() -> None:
    """Noise of few shapes, as trigger jitter has, is told from white noise at any level."""
    rng = np.random.default_rng(4)
    shape = rng.standard_normal(ATLAS.size)
    for size in (1e-3, 1.0, 1e5):
        model = model_of(size)
        alike = [model.is_alike]
        for _ in range(64):
            jitter = rng.choice([-1, 1]) * rng.uniform(0.5, 2) * shape
            model.update((size * (jitter + 0.2 * rng.standard_normal(ATLAS.size))).astype(np.float32))
        alike.append(model.is_alike)
        for _ in range(200):
            model.update((size * rng.standard_normal(ATLAS.size)).astype(np.float32))
        assert [*alike, model.is_alike] == [False, True, False]


def test_all_dead() -> None:
    """With every channel dead all are in use."""
    assert model_of(1.0, dead=(0, 1, 2, 3)).mask is None


@pytest.mark.parametrize("dead", [(), (2,)])
def test_plate_energy(dead: tuple[int, ...]) -> None:
    """`plate_energy` is what lies along the plate's directions in the channels in use, and nothing across them."""
    rng = np.random.default_rng(2)
    directions = np.linalg.qr(rng.standard_normal((ATLAS.size, 3)))[0].T.astype(np.float32)
    model = model_of(1.0, directions, dead)
    used = np.ones(ATLAS.size, np.float32) if model.mask is None else model.mask
    moved = (np.array([3.0, -1.0, 2.0]) @ directions * used).astype(np.float32)
    assert model.plate_energy(moved) == pytest.approx(float(moved @ moved), rel=1e-4)
    across = (rng.standard_normal(ATLAS.size) * used).astype(np.float32)
    basis = np.linalg.qr((directions * used).T)[0]
    across -= (basis @ (basis.T @ across)).astype(np.float32)
    assert model.plate_energy(across) < 1e-6 * float(across @ across)


def test_double() -> None:
    """A float64 atlas has its noise in float64."""
    model = NoiseModel(in_double(ATLAS))
    frames = np.random.default_rng(3).standard_normal((100, ATLAS.size))
    for frame in frames:
        model.update(frame)
    model.set_channels(np.ones(4, bool), NO_DIRECTIONS)
    assert model.noise_energy == pytest.approx(np.square(frames).mean(axis=0).sum(), rel=1e-12)


# -- a plate that sounds -----------------------------------------------------------------------------


def heard(model: NoiseModel, left: np.ndarray, t_ns: int) -> float:
    """Return the noise energy counted with in a frame that sounds, of which fingers leave this."""
    model.listen(True, t_ns)
    model.hear(left.astype(np.float32), t_ns)
    return model.noise_energy


@given(louder=st.floats(2.0, 1e3), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_a_frame_that_sounds_has_the_noise_that_fingers_leave(louder: float, seed: int) -> None:
    """So has the next one until it is fitted; any other frame, or one long after, has the usual one."""
    model, rng = model_of(1.0), np.random.default_rng(seed)
    usual, variance = model.noise_energy, model.variance
    for t_ns in range(0, 40_000_000, 8_000_000):
        left = louder * rng.standard_normal(ATLAS.size)
        assert heard(model, left, t_ns) == pytest.approx(float(left @ left), rel=1e-3)
        assert model.variance / variance == pytest.approx(model.noise_energy / usual)
    raised = model.noise_energy
    model.listen(False, 40_000_000)
    assert model.noise_energy == usual
    model.listen(True, 48_000_000)
    assert model.noise_energy == raised
    model.listen(True, 400_000_000)
    assert model.noise_energy == usual


def test_another_finger_is_no_noise() -> None:
    """What is left twice alike is not counted, nor is less than the usual noise."""
    model, rng = model_of(1.0), np.random.default_rng(5)
    usual = model.noise_energy
    finger = 10 * rng.standard_normal(ATLAS.size)
    assert heard(model, finger + rng.standard_normal(ATLAS.size), 0) > 10 * usual
    assert heard(model, finger + rng.standard_normal(ATLAS.size), 8_000_000) == usual
    assert heard(model, 0.5 * rng.standard_normal(ATLAS.size), 16_000_000) == usual
