"""Gauss-Newton in float64 finds the place that made a touch, and knows how well."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates, spline_filter

from tests.unit.training.waves import Waves
from touchd.frame import Acquisition, Plate
from touchd.localization.atlas import Atlas, AtlasDescription
from touchd.training.field.place import FieldMap, place

RIG = Acquisition(channels=3, samples=250, sample_rate_hz=250e3)
BINS = (51, 60, 70, 80)
STEP_MM, ORIGIN_MM = 2.0, (-4.0, 6.0)
INSIDE = st.tuples(st.floats(1.0, 55.0), st.floats(11.0, 65.0))


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    """A field of random waves on a grid of 33 x 34 nodes."""
    columns, rows = 33, 34
    x, y = ORIGIN_MM[0] + STEP_MM * np.arange(columns), ORIGIN_MM[1] + STEP_MM * np.arange(rows)
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    field = Waves(np.array([0.2, 0.22, 0.25, 0.28]), 3, 0).at(nodes).reshape(rows, columns, 3, 4)
    parts = np.stack([field.real, field.imag], axis=3).reshape(rows, columns, -1)
    coefficients = np.stack([spline_filter(parts[:, :, i], 3, mode="mirror") for i in range(parts.shape[2])], axis=-1)
    description = AtlasDescription(
        acquisition=RIG, plate=Plate(width_mm=60, height_mm=70), bins=BINS, step_mm=STEP_MM, origin_mm=ORIGIN_MM,
        low_mm=(0.0, 10.0), high_mm=(56.0, 66.0),
    )  # fmt: skip
    return Atlas(
        description, coefficients.astype(np.float32), np.zeros(RIG.shape, np.float32), np.zeros((3, 4), np.float32)
    )


@given(INSIDE)
def test_the_field_is_what_scipys_splines_say_and_its_derivatives_what_differences_say(
    atlas: Atlas, at: tuple[float, float]
) -> None:
    field = FieldMap(atlas)
    position_mm = np.array([at])
    u, by_x, by_y = (part[0] for part in field.look_up(position_mm))
    index = (position_mm[0, ::-1] - ORIGIN_MM[::-1]) / STEP_MM
    expected = [
        map_coordinates(atlas.coefficients[:, :, i], index[:, None], order=3, prefilter=False)[0] for i in range(24)
    ]
    parts = np.array(expected).reshape(3, 2, 4)
    np.testing.assert_allclose(u, (parts[:, 0] + 1j * parts[:, 1]).ravel(), atol=1e-5)
    step = 1e-3
    for axis, slope in enumerate((by_x, by_y)):
        off = step * np.eye(2)[axis]
        ends = [field.look_up(position_mm + sign * off)[0][0] for sign in (1, -1)]
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * step), atol=1e-4)


@given(INSIDE, st.floats(0, 2 * np.pi), st.floats(0.05, 20), st.floats(0, 6.28))
def test_from_a_millimetre_off_a_touch_without_noise_is_placed_where_it_was(
    atlas: Atlas, at: tuple[float, float], direction: float, size: float, phase: float
) -> None:
    true_mm = np.array([at])
    amplitude = size * np.exp(1j * phase)
    values = (amplitude * FieldMap(atlas).look_up(true_mm)[0]).reshape(1, 3, 4)
    start_mm = true_mm + np.array([[np.cos(direction), np.sin(direction)]])
    found = place(atlas, values, start_mm, steps=12)
    if found.misfit[0] < 1e-6:  # else it ended in another valley: rare with 12 values only
        np.testing.assert_allclose(found.position_mm, true_mm, atol=1e-3)
        assert found.amplitude[0] == pytest.approx(amplitude, rel=1e-3)


def test_nearly_all_starts_a_millimetre_off_lead_there(atlas: Atlas) -> None:
    rng = np.random.default_rng(1)
    true_mm = rng.uniform((2, 12), (54, 64), (400, 2))
    values = FieldMap(atlas).look_up(true_mm)[0].reshape(-1, 3, 4)
    angle = rng.uniform(0, 2 * np.pi, 400)
    found = place(atlas, values, true_mm + np.stack([np.cos(angle), np.sin(angle)], axis=1), steps=12)
    assert (np.linalg.norm(found.position_mm - true_mm, axis=1) < 1e-3).mean() > 0.97


def test_the_scatter_under_noise_is_what_the_information_says(atlas: Atlas) -> None:
    """The inverse Fisher information times the noise variance of a real feature is the covariance of the position."""
    rng = np.random.default_rng(2)
    n, noise = 3000, 1e-4
    true_mm = np.tile([[31.0, 37.5]], (n, 1))
    values = 1.5 * FieldMap(atlas).look_up(true_mm)[0]
    values = values + np.sqrt(noise) * (rng.normal(size=values.shape) + 1j * rng.normal(size=values.shape))
    found = place(atlas, values.reshape(n, 3, 4), true_mm)
    expected = np.linalg.inv(np.median(found.fisher_information, axis=0)) * noise
    actual = np.cov((found.position_mm - true_mm).T)
    np.testing.assert_allclose(actual, expected, atol=0.1 * np.trace(expected))


def test_no_place_is_beyond_the_touched_part_by_more_than_a_step(atlas: Atlas) -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(size=(50, 3, 4)) + 1j * rng.normal(size=(50, 3, 4))
    found = place(atlas, values, rng.uniform(-20, 90, (50, 2)))
    assert (found.position_mm >= np.array([0, 10]) - 3).all()
    assert (found.position_mm <= np.array([56, 66]) + 3).all()
    assert np.isfinite(found.fisher_information).all()
