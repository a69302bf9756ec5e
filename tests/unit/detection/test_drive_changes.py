"""Trigger jitter and ripple of the drive are known by their directions, and raise no threshold."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.fields import RIG, untouched
from touchd.config.schema import Settings
from touchd.detection.baseline import Baseline
from touchd.detection.detector import Detector
from touchd.detection.drive_changes import drive_changes
from touchd.frame import Frame
from touchd.outcome import Outcome

SIGMA = 2.0
PLATE = 10 * untouched()
SLOPE = 10 * (untouched(delay_s=1e-9) - untouched(delay_s=-1e-9)) / 2e-9
FRAMES = 48


def residuals(delay_s: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
    white = SIGMA * np.random.default_rng(seed).standard_normal((len(delay_s), *RIG.shape))
    return np.asarray(delay_s[:, None, None] * SLOPE + white)


@pytest.mark.parametrize("jitter_s", [5e-9, 20e-9, 100e-9])
def test_direction(jitter_s: float) -> None:
    """The direction is the derivative of the plate's signal, the ends of the frame included."""
    delays = jitter_s * np.random.default_rng(1).standard_normal(FRAMES)
    found = drive_changes(RIG, PLATE, residuals(delays))
    assert found is not None
    assert len(found) == 1
    noise = SIGMA / (jitter_s * np.sqrt(FRAMES)) / np.linalg.norm(SLOPE) * np.sqrt(SLOPE.size)
    assert abs(found[0] @ SLOPE.ravel()) / np.linalg.norm(SLOPE) > 1 - 2 * noise**2 - 1e-3


@pytest.mark.parametrize("share", [1e-3, 1e-2, 0.1])
def test_level(share: float) -> None:
    """That of a level is the plate's signal; with jitter both are found, and they are orthonormal."""
    rng = np.random.default_rng(4)
    level = share * rng.standard_normal(FRAMES)[:, None, None] * PLATE
    found = drive_changes(RIG, PLATE, residuals(np.zeros(FRAMES)) + level)
    assert found is not None
    assert len(found) == 1
    assert abs(found[0] @ PLATE.ravel()) / np.linalg.norm(PLATE) > 0.98
    both = drive_changes(RIG, PLATE, residuals(20e-9 * rng.standard_normal(FRAMES)) + level)
    assert both is not None
    np.testing.assert_allclose(both @ both.T, np.eye(len(both)), atol=1e-9)
    for each in (SLOPE, PLATE):
        assert np.linalg.norm(both @ each.ravel()) / np.linalg.norm(each) > 0.97


def test_none() -> None:
    """Noise alone, a plate that warms slowly, a level that drifts and a rig that hears nothing have none."""
    assert drive_changes(RIG, PLATE, residuals(np.zeros(FRAMES))) is None
    assert drive_changes(RIG, PLATE, residuals(np.linspace(-5e-10, 5e-10, FRAMES))) is None
    drifts = np.linspace(-1e-4, 1e-4, FRAMES)[:, None, None] * PLATE
    assert drive_changes(RIG, PLATE, residuals(np.zeros(FRAMES)) + drifts) is None
    assert drive_changes(RIG, 0 * PLATE, residuals(np.zeros(FRAMES))) is None


@pytest.mark.parametrize("hz", [0.0, 120.0])
def test_gate(hz: float) -> None:
    """20 ns of jitter and 1 % of ripple leave the gate as sensitive as none: its noise is white noise.

    Ripple of 120 Hz is, in 125 frames a second, as slow as a finger; the plate is learned at once nevertheless.
    """
    detector, rng, opened = Detector(RIG, Settings(), lambda *_: None), np.random.default_rng(2), 0
    delays, level = 20e-9 * rng.standard_normal(400), 0.01 * rng.standard_normal(400)
    if hz:
        level = 0.014 * np.sin(2 * np.pi * hz * np.arange(400) / 125)
    for sequence, frame in enumerate((1 + level)[:, None, None] * PLATE + residuals(delays)):
        counts = np.asarray(np.rint(frame), np.int16)
        detection = detector.detect(Frame(counts, sequence, sequence * 8_000_000, 0))
        assert sequence < 70 or detection.outcome >= Outcome.UNTOUCHED
        if detection.outcome >= Outcome.UNTOUCHED:
            opened += detection.outcome is Outcome.TOUCHED
            detector.adapt(detection, False, False, False)
    assert opened <= 2
    assert detector.noise_counts() == pytest.approx(SIGMA, rel=0.1)


def test_kept() -> None:
    """Where the plate is learned again in louder noise, which hides the delay, it is known from before."""
    baseline, rng = Baseline(RIG, Settings().baseline), np.random.default_rng(3)
    frames = PLATE + residuals(20e-9 * rng.standard_normal(FRAMES))
    baseline.learn_from(frames.astype(np.float32))
    loud = frames + 5000 * SIGMA * rng.standard_normal(frames.shape)
    assert drive_changes(RIG, PLATE, loud - PLATE) is None
    baseline.learn_from(loud.astype(np.float32))
    baseline.subtract(np.asarray(np.rint(PLATE + 50e-9 * SLOPE), np.int16), 0)
    assert baseline.drive_energy == pytest.approx(np.square(50e-9 * SLOPE).sum(), rel=0.3)
