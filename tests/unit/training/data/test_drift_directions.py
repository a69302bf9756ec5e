"""The directions in which the untouched plate moves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.evaluation.dataset import Dataset
from touchd.localization.features import Features
from touchd.recording.data import Recording
from touchd.training.data.temperature import MOST, drift_directions
from touchd.twin.instrument import REFERENCE_C, Instrument


def test_temperature_is_found_as_the_plates_own_change_with_it(dataset: Dataset, instrument: Instrument) -> None:
    """The recording's temperature walks within 1 K: what is found is what a kelvin does in the twin."""
    features = Features("frequency", dataset.acquisition)
    warm, cold = instrument.untouched([REFERENCE_C + 0.5, REFERENCE_C - 0.5])
    change = np.empty(features.size, np.float32)
    features.extract((warm - cold).astype(np.float32), change)
    found = drift_directions(dataset.untouched[::2])
    along = np.linalg.norm(found @ change) / np.linalg.norm(change)
    print(f"{len(found)} direction(s), {along:.5f} of a kelvin's change lies along")
    assert 1 <= len(found) <= 2
    assert along > 0.99


def test_a_plate_that_stands_still_has_no_direction(touches: Recording, dataset: Dataset) -> None:
    """Noise alone, with the correlation of neighbouring bins that the window brings."""
    features = Features("frequency", dataset.acquisition)
    rng = np.random.default_rng(1)
    rows = np.empty((500, features.size), np.float32)
    for row in rows:
        noise = rng.normal(scale=dataset.noise, size=touches.frames.shape[1:])
        features.extract((touches.frames[0] + noise).astype(np.float32), row)
    assert len(drift_directions(rows)) == 0


@pytest.mark.parametrize("n", [0, 1, 2, 7])
def test_too_few_frames_show_none(n: int) -> None:
    assert drift_directions(np.ones((n, 8), np.float32)).shape == (0, 8)


@given(st.integers(0, 6), st.integers(0, 2**31))
def test_directions_are_orthonormal_and_span_what_moves(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    moves = np.linalg.qr(rng.normal(size=(40, max(count, 1))))[0].T[:count]
    slowly = 50 * np.cos(np.pi * np.outer(np.arange(200) / 200, 1 + np.arange(count)))
    rows = rng.normal(size=(200, 40)) + slowly @ moves
    found = drift_directions(rows.astype(np.float32)).astype(np.float64)
    assert len(found) == min(count, MOST)
    np.testing.assert_allclose(found @ found.T, np.eye(len(found)), atol=1e-5)
    if count <= MOST:
        assert np.linalg.norm(moves - moves @ found.T @ found) < 0.2 * max(count, 1) ** 0.5
