"""The default plate, solved afresh: nothing is read from the modes that are kept on disk."""

from __future__ import annotations

import pytest

from touchd.frame import Plate
from touchd.twin.physics.plate import Modes, solve
from touchd.twin.physics.transducer import LoadedModes, default_layout, load, parameters_of

COUNTS, BELOW_HZ, FREQUENCY_HZ = (48, 48), 375e3, 125e3


@pytest.fixture(scope="session")
def glass() -> Plate:
    return Plate(width_mm=200, height_mm=200, thickness_mm=5, material="glass")


@pytest.fixture(scope="session")
def bare(glass: Plate) -> Modes:
    """Modes of the default plate without its discs, up to 375 kHz."""
    return solve(glass, COUNTS, BELOW_HZ)


@pytest.fixture(scope="session")
def loaded(glass: Plate, bare: Modes) -> LoadedModes:
    """Modes with its discs, as the instrument has them."""
    layout = default_layout(glass)
    made = parameters_of(glass, layout, FREQUENCY_HZ)
    assert (made["counts"], made["basis"] * FREQUENCY_HZ) == (COUNTS, BELOW_HZ)
    return load(bare, glass, layout, made["kept"] * FREQUENCY_HZ)
