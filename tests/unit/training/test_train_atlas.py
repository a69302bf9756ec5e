"""Whether touches are enough for an atlas, and which bins it keeps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.errors import TrainingError
from touchd.training.data.inspection import degrees_of_freedom
from touchd.training.field.make_atlas import SPARED, informative
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


@given(st.lists(st.floats(0, 1e4), min_size=1, max_size=60))
def test_the_bins_left_out_hold_a_hundredth_of_the_signal_at_most(audible: list[float]) -> None:
    power = np.array(audible)
    kept = informative(power)
    assert len(kept) >= 1
    assert power.sum() - power[kept].sum() <= SPARED * power.sum() * (1 + 1e-9)
    left_out = np.setdiff1d(np.arange(len(power)), kept)
    assert not len(left_out) or power[left_out].max() <= power[kept].min()
