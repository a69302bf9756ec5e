"""The twin hears through the filter that frames of an audio interface go through."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.audio.capture import HighPass
from touchd.frame import ACQUISITIONS
from touchd.twin.physics.filters import high_pass


@pytest.mark.parametrize("name", ["audio-96", "audio-192"])
def test_high_pass_is_that_of_the_capture(name: str) -> None:
    a = ACQUISITIONS[name]
    applied = HighPass(a.chirp.band_hz[0], a.sample_rate_hz, 1, a.samples)
    moment_s = np.arange(-applied.margin, a.samples + applied.margin) / a.sample_rate_hz
    for frequency_hz in (50.0, 1e3, 6e3, 14e3, 40e3):
        heard = applied.apply(20000 * np.cos(2 * np.pi * frequency_hz * moment_s)[None])
        expected = 20000 * np.real(
            high_pass(2 * np.pi * frequency_hz, a) * np.exp(2j * np.pi * frequency_hz * moment_s)
        )
        assert np.abs(heard[0] - expected[applied.margin : -applied.margin]).max() < 1.0


def test_a_daq_has_no_high_pass() -> None:
    assert high_pass(2 * np.pi * 50.0, ACQUISITIONS["usb"]) == 1
