"""The field between its nodes: that of the splines in float64, at the point of a fine raster that is told."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fields import COUNTS, PLATE, Field, make_atlas
from tests.fields import look_up as in_float64
from touchd.localization.spline import CELLS, PER_CELL, Lookup

ATLAS = make_atlas(Field())
ANYWHERE = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-20, 150)
RASTER_MM = ATLAS.description.step_mm / PER_CELL


def looking() -> tuple[Lookup, np.ndarray]:
    into = np.full((3, ATLAS.size), np.nan, np.float32)
    return Lookup(ATLAS, into), into


@given(ANYWHERE, ANYWHERE)
@settings(deadline=None)
def test_every_place_asked_for_has_one_inside_whose_field_is_known(x_mm: float, y_mm: float) -> None:
    lookup, into = looking()
    x, y = lookup.at(*lookup.inside(x_mm, y_mm))
    assert -RASTER_MM <= x <= PLATE.width_mm + RASTER_MM
    assert -RASTER_MM <= y <= PLATE.height_mm + RASTER_MM
    assert np.isfinite(into).all()


@given(st.floats(6, 114), st.floats(6, 84))
@settings(deadline=None)
def test_what_is_looked_up_is_the_field_of_the_point_that_is_told(x_mm: float, y_mm: float) -> None:
    """That point is within half a step of the raster; its field and slopes are those of float64, to their rounding."""
    lookup, into = looking()
    x, y = lookup.at(x_mm, y_mm)
    assert math.dist((x, y), (x_mm, y_mm)) <= RASTER_MM
    for row, exact in zip(into, in_float64(ATLAS, x, y), strict=True):
        real, imaginary = row.reshape(2, -1)
        np.testing.assert_allclose(real + 1j * imaginary, exact, atol=2e-6 * COUNTS)


@given(st.lists(st.tuples(st.floats(6, 114), st.floats(6, 84)), min_size=1, max_size=6), st.data())
@settings(deadline=None)
def test_places_may_be_asked_for_again_and_in_any_order(places: list[tuple[float, float]], data: st.DataObject) -> None:
    """More cells than are kept, and those that are kept, those that were, and those next to them."""
    lookup, into = looking()
    for at in data.draw(st.lists(st.sampled_from(places), min_size=1, max_size=4 * CELLS)):
        x, y = lookup.at(*at)
        for row, exact in zip(into, in_float64(ATLAS, x, y), strict=True):
            real, imaginary = row.reshape(2, -1)
            np.testing.assert_allclose(real + 1j * imaginary, exact, atol=2e-6 * COUNTS)


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_a_place_inside_stays_and_another_moves_to_the_nearest_edge(x_mm: float, y_mm: float) -> None:
    lookup, _ = looking()
    nearest = (
        min(max(x_mm, lookup.low_mm[0]), lookup.high_mm[0]), min(max(y_mm, lookup.low_mm[1]), lookup.high_mm[1])
    )  # fmt: skip
    assert lookup.inside(x_mm, y_mm) == nearest
