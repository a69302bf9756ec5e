"""Strengths and field are found in turn, until neither changes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.training.waves import Waves, touch
from touchd.training.field.learn import Learner, along_band, fit_amplitudes
from touchd.training.field.regression import Prior

K = np.linspace(0.2, 0.3, 9)


@given(st.integers(0, 2**31), st.floats(0.0, 0.2))
def test_a_amplitude_that_changes_along_the_band_is_found_up_to_the_common_factor(seed: int, steepness: float) -> None:
    rng = np.random.default_rng(seed)
    n, bins = 12, 9
    chosen = np.array([0, 2, 4, 6, 8])
    field = (rng.normal(size=(n, 4, 5)) + 1j * rng.normal(size=(n, 4, 5))).astype(np.complex64)
    level = np.exp(0.3 * rng.normal(size=n) + 0.2j * rng.normal(size=n))
    true = level[:, None] * (1 + steepness * along_band(bins))
    found = fit_amplitudes((field * true[:, None, chosen]).astype(np.complex64), field, along_band(bins)[chosen], bins)
    ratio = found / true
    # The prior pulls the change along the band a little towards none.
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.02 + 0.4 * steepness
    assert np.abs(found[:, 4]).mean() == pytest.approx(1, abs=0.02)


def test_the_amplitudes_of_touches_converge_to_the_true_ones() -> None:
    """Though no field is known beforehand; what is left comes from touches without neighbours on all sides."""
    touches, true = touch(Waves(K, 4, 3), 500, 60.0, 4)
    learner = Learner(touches, Prior(K))
    found = learner.converge(3).mean(axis=1)
    ratio = found / true
    ratio /= np.median(ratio.real) + 1j * np.median(ratio.imag)
    inner = (np.abs(touches.position_mm - 30) < 25).all(axis=1)
    error = np.abs(ratio - 1)[inner]
    print(f"amplitudes: median error {np.median(error):.4f}, from {np.median(np.abs(true - 1)):.3f}")
    assert np.median(error) < 0.2 * np.median(np.abs(true - 1))
