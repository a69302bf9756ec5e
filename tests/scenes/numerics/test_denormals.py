"""Numbers too small for a normal float change nothing: flushed to zero, everything is as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.scenes.numerics.degenerate import flushed, with_small_weights
from touchd.config.schema import BaselineSettings
from touchd.detection.baseline import Baseline
from touchd.frame import Acquisition
from touchd.localization.model import default_model_path
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

TINY = float(np.finfo(np.float32).tiny)


@pytest.fixture(scope="module")
def features(instrument: Instrument) -> np.ndarray:
    from touchd.evaluation.dataset import make_dataset

    return make_dataset(simulate_touches(40, seed=7203, instrument=instrument), least=1).residual


def test_denormal_weights_may_be_flushed(features: np.ndarray, tmp_path: Path) -> None:
    path = with_small_weights(0.1, 1e-38, tmp_path)
    as_they_are, zero = (flushed(path, features, flush=flush) for flush in (False, True))
    for name, value in as_they_are.items():
        assert np.isfinite(value).all()
        np.testing.assert_allclose(zero[name], value, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-45, 1e-42, 1e-40])
def test_denormal_features_may_be_flushed(scale: float, features: np.ndarray) -> None:
    small = features * np.float32(scale)
    assert (np.abs(small) < TINY).mean() > 0.05
    as_they_are, zero = (flushed(default_model_path(), small, flush=flush) for flush in (False, True))
    for name, value in as_they_are.items():
        assert np.isfinite(value).all()
        np.testing.assert_allclose(zero[name], value, rtol=1e-6, atol=1e-6)


def test_a_baseline_that_fades_stays_finite_and_harmless() -> None:
    """A channel that falls silent fades to denormals within a minute, and there it rests."""
    baseline = Baseline(Acquisition(channels=1, samples=8, sample_rate_hz=250e3), BaselineSettings())
    baseline.mean[:] = 20_000.0
    silence = np.zeros((1, 8), np.int16)
    for number in range(20_000):
        energy = baseline.subtract(silence, 8_000_000 * number)
        baseline.follow(0.0)
    assert 0 < np.abs(baseline.mean).max() < TINY
    assert energy == 0.0
