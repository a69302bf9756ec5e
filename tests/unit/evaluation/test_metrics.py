"""Each score is what its name says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.evaluation.metrics import position_scores

ERRORS = st.lists(st.tuples(st.floats(-300, 300), st.floats(-300, 300)), min_size=1, max_size=60)


@given(ERRORS)
def test_scores_follow_their_definitions(errors: list[tuple[float, float]]) -> None:
    scores = position_scores(errors)
    distances = [math.sqrt(dx * dx + dy * dy) for dx, dy in errors]
    n = len(distances)
    mean = sum(distances) / n
    expected = {
        "n": n,
        "rmse_mm": math.sqrt(sum(d * d for d in distances) / n),
        "mean_mm": mean,
        "sd_mm": math.sqrt(sum((d - mean) ** 2 for d in distances) / n),
        "median_mm": np.median(distances),
        "p95_mm": np.quantile(distances, 0.95),
        "max_mm": max(distances),
    }
    assert scores == pytest.approx(expected, abs=1e-6)


@given(ERRORS)
def test_the_rmse_is_made_of_mean_and_deviation_and_never_below_the_mean(errors: list[tuple[float, float]]) -> None:
    scores = position_scores(errors)
    assert scores["rmse_mm"] ** 2 == pytest.approx(scores["mean_mm"] ** 2 + scores["sd_mm"] ** 2, abs=1e-6)
    assert scores["mean_mm"] <= scores["rmse_mm"] + 1e-9 <= scores["max_mm"] + 2e-9


def test_the_error_is_two_dimensional_not_one_axis_of_it() -> None:
    assert position_scores([[3, 4], [-3, 4]])["rmse_mm"] == 5


def test_nothing_to_score_is_refused() -> None:
    with pytest.raises(ValueError, match="no position"):
        position_scores(np.empty((0, 2)))
