"""Standard errors are made honest: the scales that were at work are found, whatever a few touches do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.training.field.error_scale import Level, calibrate, field_error

ERROR = 0.04


def level(noise: float, scales: tuple[float, float], seed: int, label_mm: float = 0.0) -> Level:
    """Touches whose errors are those of an atlas with such scales."""
    rng = np.random.default_rng(seed)
    n = 2500
    power = np.exp(rng.normal(size=n))
    root = rng.normal(size=(n, 2, 2)) + 3 * np.eye(2)
    fisher_information = (root @ root.transpose(0, 2, 1)) * power[:, None, None] * 40
    variance = scales[0] * noise + scales[1] * ERROR * power / 2
    spread = np.linalg.cholesky(np.linalg.inv(fisher_information)) * np.sqrt(variance)[:, None, None]
    error_mm = (spread @ rng.normal(size=(n, 2, 1)))[:, :, 0] + label_mm * rng.normal(size=(n, 2))
    error_mm[: n // 50] *= 30
    variances = np.diagonal(np.linalg.inv(fisher_information), axis1=1, axis2=2)
    return Level(noise, error_mm, variances, power, label_mm)


@pytest.mark.parametrize(
    ("noise_scale", "field_scale", "label_mm"),  # any two of them together, not all three
    [
        (0.7, 0.7, 0.0), (0.7, 3.0, 0.01), (0.7, 8.0, 0.0),
        (2.0, 0.7, 0.01), (2.0, 3.0, 0.0), (2.0, 8.0, 0.01),
        (4.0, 0.7, 0.0), (4.0, 3.0, 0.01), (4.0, 8.0, 0.0),
    ],
)  # fmt: skip
def test_the_scales_at_work_are_found(noise_scale: float, field_scale: float, label_mm: float) -> None:
    """Two in a hundred touches err thirty times as much: that moves them by a little only."""
    levels = [level(noise, (noise_scale, field_scale), i, label_mm) for i, noise in enumerate((1e-3, 0.1, 1.0))]
    found = calibrate(levels, ERROR)
    assert found == pytest.approx((noise_scale, field_scale), rel=0.3)
    for one in levels:
        assert (one.ratio(*found, ERROR) <= 1).mean() == pytest.approx(0.683, abs=0.01)


@given(st.integers(0, 2**31), st.floats(0.0, 0.3), st.floats(0.0, 0.5))
def test_what_a_field_misses_is_what_is_left_less_the_noise(seed: int, missed: float, noise: float) -> None:
    rng = np.random.default_rng(seed)

    def gauss(*shape: int) -> np.ndarray:
        found: np.ndarray = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)
        return found

    n, field = 4000, gauss(4000, 2, 3)
    amplitude = np.asarray(1 + 0.3 * gauss(n), np.complex128)
    true = field + np.sqrt(missed) * gauss(n, 2, 3)
    values = amplitude[:, None, None] * true + np.sqrt(noise) * gauss(n, 2, 3)
    found = field_error(values.astype(np.complex64), field.astype(np.complex64), amplitude, noise)
    assert found.shape == (2, 3)
    np.testing.assert_allclose(found, missed, atol=0.15 * missed + 0.1 * noise + 1e-6)
    assert (found >= 0).all()
