"""What slides on the plate is heard as noise of the level asked for, other in each frame."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.frame import ACQUISITIONS
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.friction import Friction, Rub
from touchd.twin.simulate import DEFAULT_PLATE

RUB = Rub(1.0, 3.0, (30.0, 40.0), (170.0, 120.0), -30.0)


@pytest.fixture(scope="module", params=["usb", "audio-192"])
def instrument(request: pytest.FixtureRequest) -> Instrument:
    return Instrument(DEFAULT_PLATE, acquisition=ACQUISITIONS[request.param])


def in_band(signal: np.ndarray, instrument: Instrument) -> float:
    a = instrument.acquisition
    hz = np.fft.rfftfreq(a.samples, 1 / a.sample_rate_hz)
    low_hz, high_hz = a.chirp.band_hz
    spectrum = np.fft.rfft(signal * np.hanning(a.samples))[..., (hz > low_hz) & (hz < high_hz)]
    return float(np.square(np.abs(spectrum)).mean())


def test_level(instrument: Instrument) -> None:
    """It is that of the middle of the stroke, within the difference of one place to the next."""
    friction = Friction(instrument, RUB, [1])
    noise = np.stack([friction.signal(2.0 + 1e-3 * k) for k in range(40)])
    share = in_band(noise, instrument) / in_band(instrument.untouched([REFERENCE_C]), instrument)
    assert 10 * np.log10(share) == pytest.approx(RUB.level_db, abs=3)


def test_time(instrument: Instrument) -> None:
    """Before and after the stroke nothing is heard; a frame's noise is its own, and the same each time it is asked."""
    friction, other = Friction(instrument, RUB, [1]), Friction(instrument, RUB, [2])
    assert not friction.signal(0.99).any()
    assert not friction.signal(3.0).any()
    first = friction.signal(1.5)
    assert first.shape == instrument.untouched([REFERENCE_C])[0].shape
    np.testing.assert_array_equal(first, friction.signal(1.5))
    for unlike in (friction.signal(1.508), other.signal(1.5)):
        likeness = (first * unlike).sum() / np.linalg.norm(first) / np.linalg.norm(unlike)
        assert abs(likeness) < 0.3
