"""The plate, made once."""

import pytest

from touchd.twin.instrument import Instrument
from touchd.twin.simulate import DEFAULT_PLATE


@pytest.fixture(scope="session")
def instrument() -> Instrument:
    return Instrument(DEFAULT_PLATE)
