"""Another pane is as loud as stated, comes later by its clock, and changes where a finger lies on it."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.frame import ACQUISITIONS
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.other_pane import Heard, OtherPane
from touchd.twin.simulate import DEFAULT_PLATE


@pytest.fixture(scope="module", params=["usb", "audio-96"])
def instrument(request: pytest.FixtureRequest) -> Instrument:
    return Instrument(DEFAULT_PLATE, acquisition=ACQUISITIONS[request.param])


def test_level(instrument: Instrument) -> None:
    a = instrument.acquisition
    heard = Heard(instrument, OtherPane(-40.0, clocks_ppm=1e6), 125.0)  # later by all the time that has passed
    frame_s = a.samples / a.sample_rate_hz
    late_s = np.arange(0, frame_s if a.is_whole_period else 1 / 125.0, frame_s)
    peak = np.abs(instrument.untouched(np.full(1, REFERENCE_C))).max()
    assert max(np.abs(heard.signal(late)).max() for late in late_s.tolist()) == pytest.approx(0.01 * peak, rel=0.03)


def test_clock(instrument: Instrument) -> None:
    """After 250 s at 16 parts in a million a frame begins later by 4 ms."""
    slow, late = (Heard(instrument, OtherPane(-40.0, *how), 125.0) for how in ((1e-3, 16.0), (5e-3, 0.0)))
    np.testing.assert_allclose(slow.signal(250.0), late.signal(0.0), rtol=0, atol=1e-9)


def test_on_and_touched(instrument: Instrument) -> None:
    pane = OtherPane(-40.0, clocks_ppm=0.0, start_s=1.0, stop_s=4.0, touches=((2.0, 3.0),))
    heard = Heard(instrument, pane, 125.0)
    assert np.all(heard.signal(0.5) == 0)
    assert np.all(heard.signal(4.0) == 0)
    free, touched = heard.signal(1.0), heard.signal(2.5)
    change = np.square(touched - free).sum() / np.square(free).sum()
    assert 1e-3 < change < 1
    np.testing.assert_array_equal(heard.signal(3.5), free)
