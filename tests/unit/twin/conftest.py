"""The default plate, solved once for all of the twin's tests, in a cache of their own."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from touchd.frame import Plate
from touchd.twin.instrument import Instrument
from touchd.twin.physics.plate import Modes, solve
from touchd.twin.physics.transducer import LoadedModes, default_layout, loaded_modes


@pytest.fixture(scope="session", autouse=True)
def cache_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="package", autouse=True)
def one_thread() -> Iterator[None]:
    """Where other work keeps the cores busy, threads of linear algebra wait for each other many times as long."""
    with importlib.import_module("threadpoolctl").threadpool_limits(1):
        yield


@pytest.fixture(scope="session")
def glass() -> Plate:
    return Plate(width_mm=200, height_mm=200, thickness_mm=5, material="glass")


@pytest.fixture(scope="session")
def bare(glass: Plate) -> Modes:
    """Modes of the default plate without its discs, up to 375 kHz."""
    return solve(glass, (48, 48), 375e3)


@pytest.fixture(scope="session")
def loaded(glass: Plate) -> LoadedModes:
    """Modes with its discs, as the instrument has them."""
    return loaded_modes(glass, default_layout(glass))


@pytest.fixture(scope="session")
def instrument(glass: Plate) -> Instrument:
    return Instrument(glass)


@pytest.fixture(scope="session")
def small() -> Instrument:
    """A small plate, for tests that are not about the plate."""
    return Instrument(Plate(width_mm=90, height_mm=80, thickness_mm=5, material="glass"))
