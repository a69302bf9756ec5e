"""The estimators that look a frame up among the recorded touches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import KNOWN
from touchd.evaluation.dataset import Dataset
from touchd.lab.reproduction.experiments import LAGS_S, Correlation, Nearest, dictionary


def known(dataset: Dataset, method: str) -> Nearest | Correlation:
    return dictionary(dataset, dataset.residual, np.arange(KNOWN), method)


def test_each_recorded_touch_is_found_at_its_own_place(dataset: Dataset) -> None:
    recorded, place_mm = dataset.residual[:KNOWN], dataset.position_mm[:KNOWN]
    np.testing.assert_array_equal(known(dataset, "kNN").locate(recorded), place_mm)
    correlation = known(dataset, "GCC")
    assert isinstance(correlation, Correlation)
    np.testing.assert_array_equal(correlation.locate(recorded), place_mm)
    np.testing.assert_allclose(np.diag(correlation.correlate(recorded)), 1, atol=1e-5)


def test_touches_never_seen_are_placed_near_by(dataset: Dataset) -> None:
    """Both are better than the mean of all places by far."""
    unseen, place_mm = dataset.residual[KNOWN:], dataset.position_mm[KNOWN:]
    guess = np.linalg.norm(place_mm - place_mm.mean(axis=0), axis=1).mean()
    for estimator in (known(dataset, "kNN"), known(dataset, "GCC")):
        error = np.linalg.norm(estimator.locate(unseen) - place_mm, axis=1)
        print(f"{type(estimator).__name__}: mean {error.mean():.2f} mm, of a blind guess {guess:.2f} mm")
        assert np.median(error) < guess / 4


@given(st.sampled_from(list(LAGS_S)), st.floats(0.01, 100.0), st.integers(0, 2**31))
def test_the_correlation_minds_neither_size_nor_a_delay_of_a_listed_lag(lag_s: float, size: float, seed: int) -> None:
    f_hz = np.arange(51, 100) * 1e3
    rng = np.random.default_rng(seed)
    bins = rng.normal(size=(5, 3, 49)) + 1j * rng.normal(size=(5, 3, 49))

    def rows(values: np.ndarray) -> np.ndarray:
        return np.stack([values.real, values.imag], axis=2).reshape(len(values), -1).astype(np.float32)

    kept = Correlation(rows(bins), np.zeros((5, 2), np.float32), 3, f_hz)
    later = size * bins * np.exp(-2j * np.pi * f_hz * lag_s)
    peaks = kept.correlate(rows(later))
    assert (peaks.argmax(axis=1) == np.arange(5)).all()
    assert np.diag(peaks) == pytest.approx(1, abs=1e-4)
    assert (peaks <= 1 + 1e-4).all()
