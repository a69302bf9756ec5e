"""A smooth function's values follow from those at a few points."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from touchd.twin.physics import chebyshev


@given(st.floats(-3, 3), st.floats(1e-6, 2), st.integers(1, 12), st.integers(0, 2**31))
def test_polynomials_are_interpolated_exactly(centre: float, reach: float, count: int, seed: int) -> None:
    """So many points carry a polynomial of one degree less, wherever it is asked for."""
    rng = np.random.default_rng(seed)
    polynomial = np.polynomial.Polynomial(rng.standard_normal(count), [centre - reach, centre + reach], [-1, 1])
    points, at = chebyshev.points(centre, reach, count), centre + reach * rng.uniform(-1, 1, 20)
    found = chebyshev.weights(at, points) @ polynomial(points)
    np.testing.assert_allclose(found, polynomial(at), atol=1e-8 * count)


def test_a_point_has_its_own_value() -> None:
    """There the formula divides by zero."""
    points = chebyshev.points(1.0, 1e-3, 5)
    np.testing.assert_array_equal(chebyshev.weights(points, points), np.eye(5))
    np.testing.assert_array_equal(chebyshev.weights(np.ones(3), chebyshev.points(1.0, 0.0, 1)), np.ones((3, 1)))
