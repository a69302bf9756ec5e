"""The scores of a force say how well it follows the true one, and how much it depends on anything else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from touchd.evaluation.metrics import FEWEST, force_scores, monotone

VALUES = arrays(np.float64, st.integers(2, 40), elements=st.integers(0, 12).map(float))


@given(st.data(), VALUES)
def test_the_monotone_fit_is_non_decreasing_and_the_same_at_equal_x(data: st.DataObject, x: np.ndarray) -> None:
    y = data.draw(arrays(np.float64, x.shape, elements=st.floats(-5, 5)))
    fitted = monotone(x, y)
    assert (np.diff(fitted[np.argsort(x, kind="stable")]) >= -1e-12).all()
    assert all(np.ptp(fitted[x == level]) == 0 for level in x)
    assert fitted.sum() == pytest.approx(y.sum(), abs=1e-9)


def test_a_force_that_depends_on_the_true_one_alone_has_no_spread() -> None:
    force_n = np.random.default_rng(2).uniform(0.2, 3, 300)
    scores = force_scores(0.1 + force_n**0.25, force_n)
    assert scores["force_rank"] == pytest.approx(1)
    assert scores["force_spread"] == pytest.approx(0, abs=1e-12)


def test_the_spread_is_the_relative_deviation_at_equal_force() -> None:
    """A tenth, Gaussian, whatever the force: RMS 0.1, and 95 % below 0.196."""
    rng = np.random.default_rng(2)
    force_n = rng.uniform(0.2, 3, 20_000)
    scores = force_scores(np.sqrt(force_n) * (1 + 0.1 * rng.standard_normal(20_000)), force_n)
    assert scores["force_spread"] == pytest.approx(0.1, rel=0.03)
    assert scores["force_spread_p95"] == pytest.approx(0.196, rel=0.03)


def test_a_force_that_has_nothing_to_do_with_the_true_one_shows_it() -> None:
    rng = np.random.default_rng(2)
    rank = force_scores(rng.uniform(0.5, 1, 2000), rng.uniform(0.2, 3, 2000))["force_rank"]
    assert rank is not None
    assert abs(rank) < 0.06


def test_unknown_forces_are_left_out_and_few_say_nothing() -> None:
    force_n = np.linspace(1, 2, FEWEST + 5)
    force = force_n.copy()
    force[:5] = np.nan
    assert force_scores(force, force_n)["force_rank"] == pytest.approx(1)
    force[5] = np.nan
    assert set(force_scores(force, force_n).values()) == {None}
    assert set(force_scores([], []).values()) == {None}


def test_a_finder_that_states_no_force_has_no_spread() -> None:
    scores = force_scores(np.zeros(50), np.linspace(1, 2, 50))
    assert scores == {"force_rank": None, "force_spread": None, "force_spread_p95": None}
