"""The network's target histograms, places and standard errors."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from touchd.training.network.network import BINS, PositionNetwork

NETWORK = PositionNetwork(8, (200.0, 100.0), (4,))
HALF = st.floats(-0.5, 0.5, width=32)


@given(st.lists(st.tuples(HALF, HALF), min_size=1, max_size=20))
def test_a_target_histogram_sums_to_one_and_its_mean_is_the_position(places: list[tuple[float, float]]) -> None:
    position = torch.tensor(places)
    histogram = NETWORK.targets(position)
    assert histogram.shape == (len(places), 2, BINS)
    assert (histogram >= 0).all()
    np.testing.assert_allclose(histogram.sum(dim=2), 1, atol=1e-5)
    mean = (histogram * NETWORK.centres).sum(dim=2)
    # Away from the histogram's ends, which lie a bin and a half beyond the plate's edge.
    inside = position.abs() < 0.5 - 1.5 / BINS
    np.testing.assert_allclose(mean[inside], position[inside], atol=1e-3)
    np.testing.assert_allclose(mean, position, atol=5e-3)


@given(st.lists(st.tuples(HALF, HALF), min_size=1, max_size=20))
def test_the_network_says_a_place_as_its_histogram_means_it(places: list[tuple[float, float]]) -> None:
    position = torch.tensor(places)
    votes = NETWORK.targets(position).clamp_min(1e-30).log()
    position_mm = NETWORK.position_mm(votes)
    expected_mm = (position + 0.5) * torch.tensor([200.0, 100.0])
    np.testing.assert_allclose(position_mm, expected_mm, atol=1.0)


@given(st.integers(0, 1000))
def test_no_place_lies_outside_the_plate_and_every_sigma_is_positive(seed: int) -> None:
    features = 1e3 * torch.randn((16, 8), generator=torch.Generator().manual_seed(seed))
    position_mm, sigma_mm, confidence, noise_mm = NETWORK.eval()(features)
    assert ((position_mm >= 0) & (position_mm <= torch.tensor([200.0, 100.0]))).all()
    assert (sigma_mm > 0).all()
    assert (noise_mm > 0).all()
    assert ((confidence >= 0) & (confidence <= 1)).all()


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0, 10)), min_size=1, max_size=20))
def test_the_standard_error_is_the_root_of_the_sum_of_both_squares(rows: list[tuple[float, float, float]]) -> None:
    sigma, noise, ratio = np.array(rows).T
    logs = torch.from_numpy(np.stack([sigma, noise], axis=1))
    found = NETWORK.log_sigma(logs, torch.from_numpy(ratio)[:, None]).numpy()[:, 0]
    np.testing.assert_allclose(np.exp(found), np.hypot(np.exp(sigma), ratio * np.exp(noise)), rtol=1e-9)
