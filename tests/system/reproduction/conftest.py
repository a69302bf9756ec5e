"""A small robot's session over a part of the plate."""

from __future__ import annotations

import pytest

from touchd.recording.data import Recording
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches


@pytest.fixture(scope="session")
def touches(instrument: Instrument) -> Recording:
    return simulate_touches(260, seed=4, instrument=instrument, margin_mm=60.0)
