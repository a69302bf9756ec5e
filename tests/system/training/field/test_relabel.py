"""Labels that are off are found to be, by how much, and put right; labels that are right are left alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.training.field.leave_one_out import MOST_MM, Displaced, label_noise_mm, replaced


@given(st.floats(0.02, 0.5), st.floats(0.01, 0.2), st.integers(0, 2**31))
def test_the_labels_error_is_what_the_touches_own_does_not_explain(true_mm: float, own_mm: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    own = own_mm * np.exp(0.5 * rng.normal(size=2000))
    by_mm = rng.normal(size=(2000, 2)) * np.hypot(true_mm, own)[:, None]
    by_mm[:20] += 40  # in a wrong valley
    found = label_noise_mm(Displaced(by_mm, own[:, None, None] ** 2 * np.eye(2)))
    assert found == pytest.approx(true_mm, abs=0.1 * true_mm + 0.15 * own_mm)


@given(st.integers(0, 2**31), st.floats(0.05, 0.5))
def test_a_place_lies_between_label_and_sight_nearer_to_what_is_surer(seed: int, noise_mm: float) -> None:
    rng = np.random.default_rng(seed)
    label_mm, by_mm = rng.uniform(0, 100, (50, 2)), rng.normal(scale=0.3, size=(50, 2))
    sigma_mm = rng.uniform(0.01, 1, 50)
    found = replaced(label_mm, label_mm, Displaced(by_mm, sigma_mm[:, None, None] ** 2 * np.eye(2)), noise_mm)
    far = np.linalg.norm(by_mm, axis=1) > max(MOST_MM, 4 * noise_mm)
    share = noise_mm**2 / (noise_mm**2 + sigma_mm**2)
    np.testing.assert_allclose(found[~far], (label_mm + share[:, None] * by_mm)[~far])
    np.testing.assert_array_equal(found[far], label_mm[far])
