"""Touches of a plate whose temperature walked are brought to one temperature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from touchd.evaluation.dataset import make_dataset
from touchd.localization.features import band_bins, windowed_dft
from touchd.localization.plate_changes import stretched_dft
from touchd.recording.data import Recording
from touchd.training.data.temperature import NEAR_S, at_one_temperature, smooth


def test_what_warmth_did_to_the_touches_is_taken_back(touches: Recording) -> None:
    """A plate warmed in steps: each touch's residual changes as the operator says, and is changed back."""
    a = touches.acquisition
    back = windowed_dft(a, band_bins(a))
    change = stretched_dft(a, band_bins(a), 0.0)[1] @ np.linalg.pinv(back)
    stretch = np.where(np.arange(len(touches.frames)) < 400, -4e-4, 4e-4)
    frames = touches.frames.astype(np.float64)
    warmed = np.round(frames + stretch[:, None, None] * (frames @ change)).astype(np.int16)
    still, _ = at_one_temperature(touches, make_dataset(touches))
    walked = replace(touches, frames=warmed)
    before = make_dataset(walked).residual - still.residual
    corrected, reference = at_one_temperature(walked, make_dataset(walked))
    after = corrected.residual - still.residual
    apart = np.abs(np.arange(len(before)) - 200) > 10  # beyond the step itself, which neighbours smear
    left = np.square(after[apart]).sum() / np.square(before[apart]).sum()
    print(f"share of the change that is left: {left:.3f}")
    assert left < 0.1
    assert reference.shape == a.shape


@given(st.lists(st.integers(1, 200), min_size=1, max_size=60), st.integers(0, 2**31))
def test_neighbours_in_time_are_averaged_and_no_others(gaps_s: list[int], seed: int) -> None:
    time_s = np.cumsum(gaps_s).astype(float)
    values = np.random.default_rng(seed).normal(size=len(time_s))
    found = smooth(values, time_s)
    for i in range(len(values)):
        near = [j for j in range(max(0, i - 7), min(len(values), i + 8)) if abs(time_s[j] - time_s[i]) <= NEAR_S]
        assert abs(found[i] - values[near].mean()) < 1e-9
