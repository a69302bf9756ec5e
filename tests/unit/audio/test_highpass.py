"""The filter below the chirp's band."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.audio.capture import HighPass

PERIOD = 96


@pytest.mark.parametrize("start_hz", [20_000, 3000, 1000, 300])
def test_a_period_is_filtered_as_frames_are(start_hz: float) -> None:
    """Also where the filter is longer than the period."""
    period = np.random.default_rng(0).normal(0, 1000, (2, PERIOD))
    high_pass = HighPass(start_hz, 96_000, 2, PERIOD)
    at = np.arange(-high_pass.margin, PERIOD + high_pass.margin) % PERIOD
    assert np.abs(high_pass.around(period) - high_pass.apply(period[:, at])).max() < 0.6
