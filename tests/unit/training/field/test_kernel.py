"""The kernel is what it says: a covariance, limited to the band, tabulated closely enough to be solved with."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from touchd.training.field.regression import BAND_MARGIN, Kernel, covariance, distances

WAVENUMBER = st.floats(0.05, 0.5)
SHARE = st.floats(0.0, 1.0)


@given(WAVENUMBER, SHARE, st.integers(0, 2**31))
def test_it_is_a_covariance_one_at_no_distance_and_never_more(k: float, share: float, seed: int) -> None:
    position_mm = np.random.default_rng(seed).uniform(0, 60, (40, 2))
    apart_mm = np.linalg.norm(position_mm[:, None] - position_mm[None], axis=2)
    matrix = covariance(apart_mm, k, share)
    assert np.allclose(np.diag(matrix), 1, atol=1e-9)
    assert np.abs(matrix).max() < 1 + 1e-9
    assert np.linalg.eigvalsh(matrix).min() > -1e-9


@given(WAVENUMBER, SHARE, st.integers(0, 2**31))
def test_the_table_is_the_function_to_a_millionth(k: float, share: float, seed: int) -> None:
    apart_mm = np.random.default_rng(seed).uniform(0, 200, (70, 30)).astype(np.float32)
    kernel = Kernel(k, 200.0, share)
    np.testing.assert_allclose(kernel(apart_mm), covariance(apart_mm.astype(np.float64), k, share), atol=5e-6)


@given(WAVENUMBER, SHARE, st.floats(0.5, 150.0))
def test_its_slope_is_the_derivative_over_the_distance(k: float, share: float, r_mm: float) -> None:
    step = 1e-4
    ends = covariance(np.array([r_mm - step, r_mm + step]), k, share)
    expected = (ends[1] - ends[0]) / (2 * step) / r_mm
    found = Kernel(k, 200.0, share).slope(np.array([[r_mm]], np.float32))[0, 0]
    assert abs(found - expected) < 1e-3 * k**2


@given(WAVENUMBER)
def test_it_holds_no_wave_shorter_than_the_band_allows(k: float) -> None:
    """Along a line: the spectrum of a function of two dimensions, summed over one of them."""
    r_mm = np.linspace(0.0, 4095 * 0.25 / k, 4096)
    window = np.cos(np.pi / 2 * np.arange(4096) / 4096) ** 2
    half = covariance(r_mm, k) * window
    spectrum = np.abs(np.fft.rfft(np.concatenate([half, half[:0:-1]])))
    along = 2 * np.pi * np.fft.rfftfreq(2 * 4096 - 1, 0.25 / k)
    beyond = spectrum[along > 2 * 1.05 * BAND_MARGIN * k]
    assert beyond.max() < 1e-3 * spectrum.max()


@given(st.integers(0, 2**31))
def test_distances_are_those_of_the_places(seed: int) -> None:
    one, other = np.random.default_rng(seed).uniform(0, 300, (2, 9, 2))
    np.testing.assert_allclose(distances(one, other), np.linalg.norm(one[:, None] - other[None], axis=2), rtol=1e-6)
