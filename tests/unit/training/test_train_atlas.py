"""Whether touches are enough for an atlas, and which bins it keeps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.errors import TrainingError
from touchd.frame import Acquisition
from touchd.training.data.inspection import degrees_of_freedom
from touchd.training.field.bins import MOST_FEATURES, SPARED, informative
from touchd.training.train_atlas import AMPLE, HOPELESS, check_density


@given(st.integers(4, 5000), st.floats(0.1, 0.4))
def test_few_touches_are_called_few_and_hopelessly_few_refused(count: int, wavenumber_per_mm: float) -> None:
    position_mm = np.random.default_rng(count).uniform(0, 190, (count, 2))
    share = count / degrees_of_freedom(position_mm, wavenumber_per_mm)
    if share < HOPELESS:
        with pytest.raises(TrainingError, match="degrees of freedom"):
            list(check_density(position_mm, wavenumber_per_mm))
    else:
        assert len(list(check_density(position_mm, wavenumber_per_mm))) == (share < AMPLE)


def test_touches_at_one_place_are_refused() -> None:
    """Labels that are all the same tell no field."""
    with pytest.raises(TrainingError, match="one place"):
        list(check_density(np.full((200, 2), 50.0), 0.3))


def of_channels(channels: int) -> Acquisition:
    return Acquisition(channels=channels, samples=250, sample_rate_hz=250e3)


@given(st.lists(st.floats(0, 1e4), min_size=1, max_size=60))
def test_bins_left_out(audible: list[float]) -> None:
    """Of few bins those left out hold a hundredth of the signal at most."""
    power = np.array(audible)
    kept = informative(power, np.ones(len(power)), of_channels(3))
    assert len(kept) >= 1
    assert power.sum() - power[kept].sum() <= SPARED * power.sum() * (1 + 1e-9)
    left_out = np.setdiff1d(np.arange(len(power)), kept)
    assert not len(left_out) or power[left_out].max() <= power[kept].min()


@given(st.lists(st.floats(1, 1e4), min_size=101, max_size=300), st.integers(1, 8))
def test_most_features(power: list[float], channels: int) -> None:
    """Of many bins an atlas holds those that tell most of a place, up to the features that a frame has time for."""
    told = np.array(power) * np.arange(1.0, len(power) + 1) ** 2
    kept = informative(np.array(power), np.arange(1.0, len(power) + 1), of_channels(channels))
    assert 2 * channels * len(kept) <= MOST_FEATURES
    weak = np.cumsum(np.sort(power)) <= SPARED * sum(power)
    free = np.setdiff1d(np.flatnonzero(~weak[np.argsort(np.argsort(power))]), kept)
    assert not len(free) or told[free].max() <= told[kept].min()
