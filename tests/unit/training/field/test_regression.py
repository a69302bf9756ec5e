"""The error that kernel ridge regression expects of its field."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.training.waves import Waves, touch
from touchd.training.field.regression import Prior, Regression, Touches, covariance

WAVENUMBER_PER_MM = np.array([0.25, 0.35])
SIZE_MM = 60.0


@settings(max_examples=20)
@given(st.integers(0, 1000), st.integers(2, 60), st.floats(1e-4, 0.1))
def test_expected_error_against_float64(seed: int, count: int, ridge: float) -> None:
    """It agrees with the formula in double precision, between 0 and the prior's variance."""
    rng = np.random.default_rng(seed)
    touches, amplitude = touch(Waves(WAVENUMBER_PER_MM, 2, seed), count, SIZE_MM, seed)
    regression = Regression(touches, Prior(WAVENUMBER_PER_MM, ridge=ridge))
    at_mm = rng.uniform(touches.position_mm.min(axis=0), touches.position_mm.max(axis=0), (20, 2))
    found = regression.variance(1, amplitude.astype(np.complex64), at_mm)

    def kernel(one_mm: np.ndarray, other_mm: np.ndarray) -> np.ndarray:
        apart_mm = np.linalg.norm(one_mm[:, None] - other_mm[None], axis=2)
        return covariance(apart_mm, WAVENUMBER_PER_MM[1], regression.prior.white_share)

    known_mm = touches.position_mm
    penalty = regression.penalty(1, amplitude.astype(np.complex64)).astype(np.float64)
    near = kernel(known_mm, at_mm)
    expected = 1 - (near * np.linalg.solve(kernel(known_mm, known_mm) + np.diag(penalty), near)).sum(axis=0)
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_expected_error_is_the_measured_one() -> None:
    """Of touches without gaps, one that is left out lies farther from the others than any place does.

    The errors of both follow from the distances: as expected, the left out one's are larger.
    """
    waves, rng = Waves(WAVENUMBER_PER_MM, 4, 1), np.random.default_rng(2)
    side = 5.0 * np.arange(13)
    position_mm = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    left_out = rng.permutation(len(position_mm))[:30]
    known_mm = np.delete(position_mm, left_out, axis=0)
    noise = 1e-3
    values = waves.at(known_mm)
    values = values + np.sqrt(noise / 2) * (rng.normal(size=values.shape) + 1j * rng.normal(size=values.shape))
    regression = Regression(Touches(known_mm, values.astype(np.complex64), noise), Prior(WAVENUMBER_PER_MM))
    ones = np.ones(len(known_mm), np.complex64)
    weights = regression.weights(1, ones)

    def errors(at_mm: np.ndarray) -> tuple[float, float]:
        missed = regression.at(1, weights, at_mm) - waves.at(at_mm)[:, :, 1]
        measured = float(np.square(np.abs(missed)).mean()) / regression.scale[1] ** 2
        return measured, float(regression.variance(1, ones, at_mm).mean())

    anywhere, gaps = errors(rng.uniform(0, 60, (500, 2))), errors(position_mm[left_out])
    print(f"measured, expected: anywhere {anywhere}, left out {gaps}")
    assert gaps[0] / anywhere[0] == pytest.approx(gaps[1] / anywhere[1], rel=0.3)
    assert gaps[1] > 1.3 * anywhere[1]
