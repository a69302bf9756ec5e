"""The baseline is learned from a steady plate and follows it as it drifts."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.config.schema import BaselineSettings
from touchd.detection.baseline import Baseline
from touchd.evaluation.dataset import residual_of
from touchd.frame import ACQUISITIONS

SHAPE = ACQUISITIONS["usb"].shape
SETTINGS = BaselineSettings()
PERIOD_NS = 8_000_000
MEAN, TOUCH = np.random.default_rng(0).standard_normal((2, *SHAPE)) * [[[5000]], [[150]]]


class Plate:
    """Shows a baseline noisy frames, 8 ms apart."""

    def __init__(self, seed: int, noise: float = 10.0) -> None:
        self.baseline, self.t_ns = Baseline(ACQUISITIONS["usb"], SETTINGS), 0
        self._rng, self._noise = np.random.default_rng(seed), noise

    def frame(self, mean: np.ndarray) -> np.ndarray:
        return np.rint(mean + self._noise * self._rng.standard_normal(SHAPE)).astype(np.int16)

    def learn(self, means: list[np.ndarray]) -> tuple[int, np.ndarray] | None:
        """The number of frames it took, and the energies."""
        for number, mean in enumerate(means, 1):
            self.t_ns += PERIOD_NS
            if (energies := self.baseline.learn(self.frame(mean), self.t_ns)) is not None:
                return number, energies
        return None

    def subtract(self, mean: np.ndarray, after_ns: int = PERIOD_NS) -> float:
        self.t_ns += after_ns
        return self.baseline.subtract(self.frame(mean), self.t_ns)


def test_steady_plate() -> None:
    """A steady plate is learned from its first 32 frames."""
    plate = Plate(1)
    learned = plate.learn([MEAN] * 100)
    assert learned is not None
    assert learned[0] == 32
    assert np.sqrt(np.mean((plate.baseline.mean - MEAN) ** 2)) == pytest.approx(10 / np.sqrt(32), rel=0.1)


def test_energies() -> None:
    """The energies learned are those of later frames, though the mean holds the frames themselves."""
    plate = Plate(2)
    learned = plate.learn([MEAN] * 32)
    assert learned is not None
    assert learned[1].mean() == pytest.approx(np.mean([plate.subtract(MEAN) for _ in range(200)]), rel=0.05)


def test_touched_while_learning() -> None:
    """A plate touched meanwhile is learned once it is steady."""
    plate = Plate(3)
    learned = plate.learn([MEAN + TOUCH * (10 <= i < 40) for i in range(200)])
    assert learned is not None
    assert learned[0] > 40
    assert np.abs(plate.baseline.mean - MEAN).max() < 10


@pytest.mark.parametrize(("on", "off"), [(15, 12), (15, 31), (20, 10)])
def test_typing_while_learning(on: int, off: int) -> None:
    """Of a plate that is typed on all the time the frames between touches are learned, within two seconds."""
    plate, rng = Plate(6), np.random.default_rng(7)
    touches = rng.standard_normal((40, *SHAPE)) * 150
    learned = plate.learn([MEAN + touches[i // (on + off)] * (i % (on + off) < on) for i in range(800)])
    assert learned is not None
    assert learned[0] < 250
    assert np.sqrt(np.mean((plate.baseline.mean - MEAN) ** 2)) < 10 / np.sqrt(8)
    assert learned[1].mean() == pytest.approx(10**2 * MEAN.size, rel=0.1)


def test_never_steady() -> None:
    """A plate that never gets steady is learned all the same."""
    assert Plate(4).learn([MEAN * (1 + 1e-3 * i) for i in range(2000)]) is not None


def test_quickly() -> None:
    """Movement of the plate's own is followed 8 times as fast, and what comes after it as before."""
    plate = Plate(5, noise=0.0)
    plate.learn([np.rint(MEAN)] * 32)
    steps = []
    for quickly in (True, False):
        before = plate.baseline.mean.copy()
        plate.subtract(np.rint(before) + 100, PERIOD_NS)
        plate.baseline.follow(0.0, quickly=quickly)
        steps.append(float((plate.baseline.mean - before).mean()))
    expected = [100 * s / (SETTINGS.time_constant_s + s) for s in (8 * PERIOD_NS * 1e-9, PERIOD_NS * 1e-9)]
    assert steps == pytest.approx(expected, rel=0.1)


def test_noise_alone() -> None:
    """Of a plate that is loud the noise is learned, and the mean stays what it was before."""
    plate = Plate(7)
    plate.learn([MEAN] * 32)
    plate.baseline.end(1.0)
    before = plate.baseline.mean.copy()
    plate.baseline.reset(keep_mean=True)
    learned = Plate(8, noise=1000.0)
    learned.baseline = plate.baseline
    found = learned.learn([MEAN] * 32)
    assert found
    residuals = plate.baseline.end(1e4)
    np.testing.assert_array_equal(plate.baseline.mean, before)
    assert np.sqrt(np.square(residuals).mean()) == pytest.approx(1000, rel=0.05)


def test_loud_noise_moves_the_mean_the_less() -> None:
    """As the noise grows, what it adds to the mean stays; once it has gone, the plate is followed as ever."""
    plate = Plate(9, noise=0.0)
    plate.learn([np.rint(MEAN)] * 32)
    plate.baseline.end(1.0)

    def step(noise_energy: float) -> float:
        before = plate.baseline.mean.copy()
        plate.subtract(np.rint(before) + 100)
        plate.baseline.follow(noise_energy)
        return float((plate.baseline.mean - before).mean())

    usual = step(1.0)
    assert step(1.5) == pytest.approx(usual, rel=0.02)
    assert step(10.0) == pytest.approx(usual / 10, rel=0.02)
    assert step(1e9) == pytest.approx(usual / 100, rel=0.02)
    assert step(5.0) == pytest.approx(usual, rel=0.02), "it has fallen: what is left of it is in the mean"
    for _ in range(60 * 125):
        step(1e4)
    assert step(1e4) == pytest.approx(usual, rel=0.02), "in a minute it is the usual"
    step(0.0)
    for _ in range(60 * 125):
        step(1.0)
    assert step(1.0) == pytest.approx(usual, rel=0.02), "so it is after silence"


@pytest.mark.parametrize(("gap_ns", "share"), [(3_600_000_000_000, 0.1 / 0.6), (-5_000_000, 0.0), (0, 0.0)])
def test_gap(gap_ns: int, share: float) -> None:
    """The first frame after a gap moves the baseline by 0.1 s at most, and a clock that steps back moves nothing."""
    plate = Plate(6, noise=0.0)
    plate.learn([np.rint(MEAN)] * 32)
    plate.subtract(np.rint(MEAN) + 100, gap_ns)
    plate.baseline.follow(0.0)
    np.testing.assert_allclose(plate.baseline.mean - np.rint(MEAN), 100 * share, atol=1e-3)


@pytest.mark.parametrize(
    ("time_constant_s", "period_ns"), [(60.0, 1_000_000), (600.0, PERIOD_NS), (3600.0, 20_000_000)]
)
def test_long_time_constant(time_constant_s: float, period_ns: int) -> None:
    """A plate that drifts over hours is followed as it is over seconds, though a frame's part is next to nothing."""
    plate = Plate(8, noise=1.0)
    plate.learn([MEAN] * 32)
    before = plate.baseline.mean.copy()
    plate.baseline.configure(SETTINGS.model_copy(update={"time_constant_s": time_constant_s}))
    drifted = [plate.frame(MEAN + 3) for _ in range(8)]
    frames = round(0.25e9 * time_constant_s / period_ns)
    for number in range(frames):
        plate.t_ns += period_ns
        plate.baseline.subtract(drifted[number % 8], plate.t_ns)
        plate.baseline.follow(0.0)
    assert (plate.baseline.mean - before).mean() == pytest.approx(3 * (1 - np.exp(-0.25)), rel=0.1)


def test_full_scale() -> None:
    """The residual of full-scale frames does not wrap."""
    plate = Plate(7, noise=0.0)
    plate.learn([np.full(SHAPE, -32768.0)] * 32)
    assert plate.subtract(np.full(SHAPE, 32767.0)) == pytest.approx(65535.0**2 * 1000, rel=1e-5)
    assert (plate.baseline.residual == 65535).all()


def test_arithmetic_of_training() -> None:
    """The residual is that of the training set, bit for bit."""
    plate = Plate(8)
    plate.learn([MEAN] * 32)
    counts = plate.frame(MEAN)
    plate.baseline.subtract(counts, plate.t_ns)
    assert (plate.baseline.residual == residual_of(counts, plate.baseline.mean)).all()
