"""A finger has one phase all over the plate, and nothing else of the field changes by it."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.training.field.test_place import atlas  # noqa: F401  the same field of random waves
from touchd.localization.atlas import Atlas
from touchd.training.field.make_atlas import aligned, mean_direction
from touchd.training.field.place import FieldMap, place


def lead_rad(position_mm: np.ndarray) -> np.ndarray:
    """Half a radian about one place, as where a transducer loads the plate."""
    found: np.ndarray = 0.5 * np.exp(-np.square(position_mm - [25.0, 35.0]).sum(axis=1) / (2 * 9.0**2))
    return found


def test_touches_of_a_phase_of_their_own_place_get_the_same_all_over(atlas: Atlas) -> None:  # noqa: F811  that fixture
    rng = np.random.default_rng(0)
    position_mm = rng.uniform((0, 10), (56, 66), (1500, 2))
    amplitude = np.exp(1j * lead_rad(position_mm)) * np.exp(0.3 * rng.normal(size=1500))
    turned = aligned(atlas, position_mm, amplitude)
    true_mm = rng.uniform((4, 14), (52, 62), (200, 2))
    values = (np.exp(1j * lead_rad(true_mm))[:, None] * FieldMap(atlas).look_up(true_mm)[0]).reshape(-1, 3, 4)
    before, after = place(atlas, values, true_mm), place(turned, values, true_mm)
    spread = [float(np.ptp(np.angle(one.amplitude))) for one in (before, after)]
    print(f"spread of phases {spread[0]:.2f} before, {spread[1]:.2f} rad after")
    assert spread[1] < 0.4 * spread[0]
    assert np.median(np.linalg.norm(after.position_mm - true_mm, axis=1)) < 0.02
    np.testing.assert_allclose(np.abs(after.amplitude), 1, atol=0.02)


@given(st.integers(0, 2**31), st.floats(-3.1, 3.1))
def test_a_phase_common_to_all_touches_is_taken_over_where_there_are_touches(seed: int, phase: float) -> None:
    rng = np.random.default_rng(seed)
    position_mm = rng.uniform(0, 30, (3000, 2))
    amplitude = np.exp(1j * phase) * np.exp(rng.normal(size=3000))
    near, far = mean_direction(np.array([[15.0, 15.0], [200.0, 200.0]]), position_mm, amplitude)
    assert abs(near - np.exp(1j * phase)) < 0.05
    assert abs(far - 1) < 1e-9
