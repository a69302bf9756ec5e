"""The assignment has the least total cost."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from touchd.tracking.assignment import assign


@given(st.integers(1, 5), st.integers(0, 3), st.integers(0, 2**32 - 1))
def test_least_cost(rows: int, more: int, seed: int) -> None:
    """No other assignment is cheaper."""
    cost = np.random.default_rng(seed).uniform(0, 100, (rows, rows + more))
    columns = assign(cost.tolist())
    assert len(set(columns)) == rows
    cheapest = min(sum(cost[i, j] for i, j in enumerate(p)) for p in permutations(range(rows + more), rows))
    assert sum(cost[i, j] for i, j in enumerate(columns)) == pytest.approx(cheapest)


def test_scipy() -> None:
    """Ten fingers are assigned as scipy assigns them."""
    cost = np.random.default_rng(1).uniform(0, 200, (10, 20))
    mine, theirs = assign(cost.tolist()), linear_sum_assignment(cost)[1]
    assert mine == theirs.tolist()


def test_more_rows_than_columns() -> None:
    """More rows than columns are refused."""
    with pytest.raises(ValueError, match="3 rows cannot be assigned to 2 columns"):
        assign([[1.0, 2.0]] * 3)
