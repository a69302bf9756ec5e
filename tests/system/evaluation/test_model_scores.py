"""A judgement's scores and pictures' numbers, against their definitions on touches made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.evaluation.model_scores import Judgement, classes, scores
from touchd.evaluation.plots.maps import cell_medians
from touchd.evaluation.plots.model import confusion, sigma_deciles
from touchd.frame import Plate
from touchd.localization.model import Model

PLATE = Plate(width_mm=200, height_mm=100)


def test_classes_are_told_apart_and_keys_taken_for_keys_are_counted() -> None:
    """Classes 0 and 1 are keys, 2 is beside: missing a key, or finding one beside, takes no key for another."""
    truth, found = np.array([0, 0, 0, 1, 1, 2, 2]), np.array([0, 1, 2, 1, 0, 2, 0])
    said = Judgement(np.zeros((7, 2), np.float32), np.zeros((7, 2)), np.ones(7), np.ones(7), truth, found, keys=2)
    assert scores(said)["accuracy"] == pytest.approx(3 / 7)
    assert scores(said)["key_to_key_errors"] == 2
    np.testing.assert_array_equal(confusion(said, 3), [[1, 1, 1], [1, 1, 0], [1, 0, 1]])


@given(st.lists(st.tuples(st.floats(0, 200), st.floats(0, 150)), min_size=1, max_size=20), st.integers(2, 10))
def test_a_zone_is_where_its_rectangle_lies(model: Model, places: list[tuple[float, float]], n: int) -> None:
    plate = Plate(width_mm=200, height_mm=150)
    about = model.description.model_copy(update={"head": "grid", "grid": n, "plate": plate})
    true_mm = np.array(places, np.float32)
    row, column = np.divmod(classes(true_mm, about), n)
    centre_mm = (np.stack([column, row], axis=1) + 0.5) * np.array([200, 150]) / n
    assert (np.abs(true_mm - centre_mm) <= np.array([100, 75]) / n + 1e-3).all()


@given(st.integers(1, 500), st.integers(0, 100))
def test_every_touch_lies_in_one_cell_of_the_map_with_the_median_of_its_touches(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    position_mm = rng.uniform(0, [200, 100], (count, 2)).astype(np.float32)
    value = rng.uniform(1, 2, count)
    medians, many = cell_medians(position_mm, value, PLATE)
    assert many.sum() == count
    assert np.isnan(medians[many == 0]).all()
    i = int(np.argmax(many))
    row, column = divmod(i, many.shape[1])
    size_mm = np.array([200 / many.shape[1], 100 / many.shape[0]])
    inside = (np.floor(position_mm / size_mm) == [column, row]).all(axis=1)
    assert medians[row, column] == pytest.approx(np.median(value[inside]))


def test_the_tenths_of_a_right_standard_error_lie_on_the_line() -> None:
    rng = np.random.default_rng(3)
    sigma_mm = rng.uniform(0.2, 2.0, 50_000)
    zero = np.zeros((50_000, 2))
    said = Judgement(zero.astype(np.float32), zero + rng.standard_normal((50_000, 2)) * sigma_mm[:, None],
                     sigma_mm, np.ones(50_000))  # fmt: skip
    predicted, actual = sigma_deciles(said)
    np.testing.assert_allclose(actual, predicted, rtol=0.05)
    _, doubled = sigma_deciles(replace(said, position_mm=2 * said.position_mm))
    np.testing.assert_allclose(doubled, 2 * predicted, rtol=0.05)
