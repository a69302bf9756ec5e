"""What the experiments are made on, and how they are scored."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from touchd.evaluation.model_scores import Judgement, labels_of
from touchd.keypad import PHONE, load_layout
from touchd.lab.reproduction import paper
from touchd.lab.reproduction.experiments import keypad_scores, zone_accuracy
from touchd.lab.reproduction.sets import central
from touchd.recording.data import Recording
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

LAYOUT = load_layout(PHONE)
KEYS = len(LAYOUT.key)


def judgement(
    true_mm: NDArray[np.float64], position_mm: NDArray[np.float64], found_class: NDArray[np.int64] | None = None
) -> Judgement:
    """Estimates of which only the positions are known, and the classes of a classifier."""
    unknown = np.full(len(true_mm), np.nan)
    return Judgement(true_mm.astype(np.float32), position_mm, unknown, unknown, found_class=found_class)


@pytest.fixture(scope="module")
def touches(instrument: Instrument) -> Recording:
    """A small robot's session over a part of the plate."""
    return simulate_touches(260, seed=4, instrument=instrument, margin_mm=60.0)


@pytest.mark.parametrize(("n", "mean_mm"), [(2, 38.3), (10, 7.65)])
def test_a_perfect_classifier_has_the_error_of_its_zones(n: int, mean_mm: float) -> None:
    """Against the figures known for 20 x 20 cm, and against the middle points of a fine grid over a zone."""
    assert paper.perfect_mean_mm(200.0, n) == pytest.approx(mean_mm, abs=0.05)
    at = (np.arange(1000) + 0.5) / 1000 - 0.5
    x, y = np.meshgrid(at, at)
    assert paper.perfect_mean_mm(1.0, 1) == pytest.approx(np.hypot(x, y).mean(), rel=1e-5)


def test_the_central_square_is_a_plate_of_its_own(touches: Recording) -> None:
    """Touches elsewhere are left out, the others keep their frames and their distances from each other."""
    middle = central(touches, 50.0)
    assert touches.contacts_mm is not None
    assert middle.contacts_mm is not None
    place_mm = touches.contacts_mm[:, 0]
    inside = (np.abs(place_mm - 100) <= 25).all(axis=1)
    assert 0 < inside.sum() < np.isfinite(place_mm[:, 0]).sum()
    down = np.isfinite(middle.contacts_mm[:, 0, 0])
    np.testing.assert_allclose(middle.contacts_mm[down, 0], place_mm[inside] - 75, atol=1e-4)
    np.testing.assert_array_equal(middle.frames[down], touches.frames[inside])
    assert (~down).sum() == np.isnan(place_mm[:, 0]).sum()
    assert (middle.meta.plate.width_mm, middle.meta.plate.height_mm) == (50, 50)


@given(st.integers(1, 200), st.integers(0, 2**31))
def test_accuracy_is_the_share_on_the_confusion_matrixs_diagonal(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth_mm, found = rng.uniform(0, 200, (n, 2)), rng.integers(0, 13, n)
    judged = judgement(truth_mm, np.zeros((n, 2)), found)
    matrix = np.zeros((KEYS + 1, KEYS + 1), int)
    np.add.at(matrix, (labels_of(truth_mm, LAYOUT), found), 1)
    scores = keypad_scores(judged, LAYOUT)
    assert scores["accuracy"] == pytest.approx(np.trace(matrix) / n)
    off = matrix[:KEYS, :KEYS].sum() - np.trace(matrix[:KEYS, :KEYS])
    assert scores["key_to_key_errors"] == off


@given(st.integers(1, 100), st.integers(2, 10), st.integers(0, 2**31))
def test_a_zone_is_right_where_its_middle_is_nearest(n: int, grid: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth_mm = rng.uniform(0, 100, (n, 2))
    own_mm = (np.floor(truth_mm / (100 / grid)) + 0.5) * 100 / grid
    wrong = rng.uniform(size=n) < 0.3
    other_mm = (own_mm + 100 / grid) % 100
    place_mm = np.where(wrong[:, None], other_mm, own_mm)
    accuracy = zone_accuracy(judgement(truth_mm, place_mm), grid, (100.0, 100.0))
    assert accuracy == pytest.approx(1 - wrong.mean())
