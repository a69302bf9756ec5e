"""The default plate, solved afresh: nothing is read from the modes that are kept on disk."""

from __future__ import annotations

import pytest

from touchd.frame import Plate
from touchd.twin.physics.plate import Modes, solve
from touchd.twin.physics.transducer import LoadedModes, default_layout, loaded_modes


@pytest.fixture(scope="session")
def glass() -> Plate:
    return Plate(width_mm=200, height_mm=200, thickness_mm=5, material="glass")


@pytest.fixture(scope="session")
def bare(glass: Plate) -> Modes:
    """Modes of the default plate without its discs, up to 375 kHz."""
    return solve(glass, (48, 48), 375e3)


@pytest.fixture(scope="session")
def loaded(glass: Plate, tmp_path_factory: pytest.TempPathFactory) -> LoadedModes:
    """Modes with its discs, as the instrument has them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        return loaded_modes(glass, default_layout(glass))
