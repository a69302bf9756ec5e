"""Trigger jitter is known by its direction, and raises no threshold."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.fields import RIG, untouched
from touchd.config.schema import Settings
from touchd.detection.baseline import Baseline
from touchd.detection.detector import Detector
from touchd.detection.jitter import delay_direction
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
    direction = delay_direction(PLATE, residuals(delays))
    assert direction is not None
    noise = SIGMA / (jitter_s * np.sqrt(FRAMES)) / np.linalg.norm(SLOPE) * np.sqrt(SLOPE.size)
    assert abs(direction @ SLOPE.ravel()) / np.linalg.norm(SLOPE) > 1 - 2 * noise**2 - 1e-3


def test_none() -> None:
    """Noise alone, a plate that warms slowly and a rig that hears nothing have no jitter."""
    assert delay_direction(PLATE, residuals(np.zeros(FRAMES))) is None
    assert delay_direction(PLATE, residuals(np.linspace(-5e-10, 5e-10, FRAMES))) is None
    assert delay_direction(0 * PLATE, residuals(np.zeros(FRAMES))) is None


def test_gate() -> None:
    """20 ns of jitter leave the gate as sensitive as none: its noise is white noise."""
    detector = Detector(RIG, Settings(), lambda *_: None)
    delays = 20e-9 * np.random.default_rng(2).standard_normal(400)
    opened = 0
    for sequence, frame in enumerate(PLATE + residuals(delays)):
        counts = np.asarray(np.rint(frame), np.int16)
        detection = detector.detect(Frame(counts, sequence, sequence * 8_000_000, 0))
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
    assert delay_direction(PLATE, loud - PLATE) is None
    baseline.learn_from(loud.astype(np.float32))
    baseline.subtract(np.asarray(np.rint(PLATE + 50e-9 * SLOPE), np.int16), 0)
    assert baseline.delay_energy == pytest.approx(np.square(50e-9 * SLOPE).sum(), rel=0.3)
