"""The regression in float32 is the one in float64, and its prior is chosen by what places touches best."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.training.waves import Waves, touch
from touchd.training.field.leave_one_out import RIDGES, WHITE_SHARES, choose, log_errors, region_of
from touchd.training.field.regression import Prior, Regression, Touches, covariance, each, smooth

K = np.linspace(0.2, 0.3, 3)


@pytest.fixture(scope="module")
def made() -> tuple[Touches, np.ndarray]:
    return touch(Waves(K, 2, 11), 300, 60.0, 12)


def apart(one_mm: np.ndarray, other_mm: np.ndarray) -> np.ndarray:
    found: np.ndarray = np.linalg.norm(one_mm[:, None] - other_mm[None], axis=2)
    return found


@pytest.mark.parametrize("b", [0, 1, 2])
def test_the_field_is_that_of_a_dense_solution_in_float64(b: int, made: tuple[Touches, np.ndarray]) -> None:
    touches, true = made
    prior = Prior(K, ridge=3e-4)
    regression, amplitude = Regression(touches, prior), true.astype(np.complex64)
    nodes_mm = np.random.default_rng(0).uniform(-4, 64, (700, 2))
    found = regression.at(b, regression.weights(b, amplitude), nodes_mm)
    position_mm, z = touches.position_mm, amplitude.astype(np.complex128)
    power = np.square(np.abs(touches.values[:, :, b].astype(np.complex128))).mean() - touches.noise
    system = covariance(apart(position_mm, position_mm), K[b], prior.white_share)
    system += np.diag((touches.noise / power + prior.ridge) / np.abs(z) ** 2)
    weights = np.linalg.solve(system, touches.values[:, :, b] / z[:, None])
    expected = covariance(apart(nodes_mm, position_mm), K[b], prior.white_share) @ weights
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


def test_with_the_inverse_it_says_the_same_at_the_touches_own_places(made: tuple[Touches, np.ndarray]) -> None:
    touches, true = made
    regression, amplitude = Regression(touches, Prior(K)), true.astype(np.complex64)
    inverse, penalty = regression.inverse(1, amplitude), regression.penalty(1, amplitude)
    targets = regression.targets(1, amplitude)
    own = smooth(inverse, penalty, targets).view(np.complex64) * np.float32(regression.scale[1])
    expected = regression.at(1, regression.weights(1, amplitude), touches.position_mm)
    assert np.abs(own - expected).max() < 2e-3 * np.abs(expected).max()


@given(st.integers(2, 400), st.integers(1, 400), st.integers(0, 2**31))
def test_a_region_is_a_corner_with_all_its_touches(count: int, most: int, seed: int) -> None:
    position_mm = np.random.default_rng(seed).uniform(0, 100, (count, 2))
    values = np.arange(count, dtype=np.complex64)[:, None, None]
    region = region_of(Touches(position_mm, values, 0.0), most)
    assert len(region.at) == min(most, count)
    np.testing.assert_array_equal(region.touches.position_mm, position_mm[region.at])
    np.testing.assert_array_equal(region.touches.values[:, 0, 0].real, region.at)
    rest = np.delete(position_mm, region.at, axis=0)
    if len(rest):
        low, span = position_mm.min(axis=0), np.ptp(position_mm, axis=0)
        assert ((rest - low) / span).max(axis=1).min() >= ((position_mm[region.at] - low) / span).max(axis=1).max()
    else:
        assert region.inner.all()


def test_a_wrong_wavenumber_surprises_and_so_does_no_ridge_at_all_for_wrong_labels() -> None:
    """Labels off by half a millimetre look like noise: the prior that is chosen trusts the touches less."""
    touches, true = touch(Waves(K, 4, 13), 500, 60.0, 14)
    amplitude = np.repeat(true[:, None], 3, axis=1).astype(np.complex64)
    region = region_of(touches)
    bins = np.arange(3)
    right, wrong = (sum(log_errors(region, Prior(factor * K), amplitude, bins)) for factor in (1.0, 0.8))
    assert right < wrong
    off_mm = 0.5 * np.random.default_rng(15).normal(size=touches.position_mm.shape)
    sloppy = Touches(touches.position_mm + off_mm, touches.values, touches.noise)
    exact, loose = (choose(one, Prior(K), amplitude, bins) for one in (touches, sloppy))
    assert exact.ridge < loose.ridge
    assert {exact.ridge, loose.ridge} <= set(RIDGES)
    assert {exact.white_share, loose.white_share} <= set(WHITE_SHARES)


def test_the_work_of_all_bins_comes_back_in_their_order_and_each_is_told() -> None:
    told = []
    assert each(lambda b: b * b, np.array([5, 3, 4]), lambda: told.append(1)) == [25, 9, 16]
    assert len(told) == 3
