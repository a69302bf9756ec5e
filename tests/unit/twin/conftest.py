"""A small plate, for tests that are not about the plate."""

from __future__ import annotations

import pytest

from touchd.frame import Plate
from touchd.twin.instrument import Instrument


@pytest.fixture(scope="session")
def glass() -> Plate:
    return Plate(width_mm=200, height_mm=200, thickness_mm=5, material="glass")


@pytest.fixture(scope="session")
def small() -> Instrument:
    return Instrument(Plate(width_mm=90, height_mm=80, thickness_mm=5, material="glass"))
