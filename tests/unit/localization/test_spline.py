"""The field between its nodes is that of the splines' definition, in float32 and in float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fields import COUNTS, PLATE, Field, in_double, make_atlas
from tests.fields import look_up as defined
from touchd.localization.spline import CELLS, Spline
from touchd.localization.spline_weights import PER_CELL

ATLAS = make_atlas(Field())
ANYWHERE = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-20, 150)
INSIDE = st.tuples(st.floats(6, 114), st.floats(6, 84))
RASTER_MM = ATLAS.description.step_mm / PER_CELL


def splines(dtype: type = np.float32) -> tuple[Spline, np.ndarray]:
    into: np.ndarray = np.full((3, ATLAS.size), np.nan, dtype)
    return Spline(ATLAS if dtype is np.float32 else in_double(ATLAS), into), into


def check(into: np.ndarray, x_mm: float, y_mm: float, atol: float) -> None:
    for row, exact in zip(into, defined(ATLAS, x_mm, y_mm), strict=True):
        real, imaginary = row.reshape(2, -1)
        np.testing.assert_allclose(real + 1j * imaginary, exact, atol=atol)


@given(ANYWHERE, ANYWHERE)
def test_any_position(x_mm: float, y_mm: float) -> None:
    """Every position, a number or not, has one inside whose field is known."""
    spline, into = splines()
    x, y = spline.at(*spline.inside(x_mm, y_mm))
    assert -RASTER_MM <= x <= PLATE.width_mm + RASTER_MM
    assert -RASTER_MM <= y <= PLATE.height_mm + RASTER_MM
    assert np.isfinite(into).all()


@pytest.mark.parametrize(("dtype", "rounding"), [(np.float32, 2e-6), (np.float64, 1e-13)])
@given(at=INSIDE)
def test_definition(dtype: type, rounding: float, at: tuple[float, float]) -> None:
    """Field and slopes at the nearest point of the raster are those of the definition, to rounding."""
    spline, into = splines(dtype)
    x, y = spline.at(*at)
    assert math.dist((x, y), at) <= RASTER_MM
    check(into, x, y, rounding * COUNTS)


@given(st.lists(INSIDE, min_size=1, max_size=6), st.data())
def test_any_order(positions: list[tuple[float, float]], data: st.DataObject) -> None:
    """Positions may come again and in any order: of cells that are cached, that were, and that never were."""
    spline, into = splines()
    for at in data.draw(st.lists(st.sampled_from(positions), min_size=1, max_size=4 * CELLS)):
        check(into, *spline.at(*at), 2e-6 * COUNTS)


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_nearest_edge(x_mm: float, y_mm: float) -> None:
    """A position inside stays, and another moves to the nearest edge."""
    spline, _ = splines()
    (low_x, low_y), (high_x, high_y) = spline.low_mm, spline.high_mm
    assert spline.inside(x_mm, y_mm) == (min(max(x_mm, low_x), high_x), min(max(y_mm, low_y), high_y))
