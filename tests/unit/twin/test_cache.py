"""Long computations are done once, and a broken cache only costs time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from touchd.frame import Plate
from touchd.twin.cache import Arrays, folder, remember
from touchd.twin.instrument import Instrument
from touchd.twin.physics import transducer


class Count:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> Arrays:
        self.calls += 1
        return {"a": np.arange(5.0)}


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return folder()


@pytest.mark.usefixtures("home")
def test_the_same_parameters_are_computed_once() -> None:
    compute = Count()
    for _ in range(3):
        np.testing.assert_array_equal(remember("x", {"n": 1}, compute)["a"], np.arange(5.0))
    assert compute.calls == 1


@pytest.mark.usefixtures("home")
def test_other_parameters_are_computed_anew() -> None:
    compute = Count()
    remember("x", {"n": 1}, compute)
    remember("x", {"n": 2}, compute)
    assert compute.calls == 2


@pytest.mark.parametrize("damage", [b"", b"not a zip file", b"PK\x03\x04 cut off"])
def test_a_damaged_file_is_replaced(home: Path, damage: bytes) -> None:
    compute = Count()
    remember("x", {}, compute)
    (file,) = home.iterdir()
    file.write_bytes(damage)
    np.testing.assert_array_equal(remember("x", {}, compute)["a"], np.arange(5.0))
    remember("x", {}, compute)
    assert compute.calls == 2


def test_a_folder_that_cannot_be_written_costs_only_time(home: Path) -> None:
    home.parent.write_text("a file where the folder should be")
    compute = Count()
    for _ in range(2):
        np.testing.assert_array_equal(remember("x", {}, compute)["a"], np.arange(5.0))
    assert compute.calls == 2


def test_without_a_home_folder_nothing_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr("touchd.twin.cache.folder", homeless)
    np.testing.assert_array_equal(remember("x", {}, Count())["a"], np.arange(5.0))


def test_no_temporary_file_is_left_behind(home: Path) -> None:
    remember("x", {}, Count())
    assert [path.suffix for path in home.iterdir()] == [".npz"]


@pytest.mark.usefixtures("home")
def test_a_second_start_solves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    first = Instrument(Plate(width_mm=90, height_mm=80, thickness_mm=5, material="glass"))

    def solve(*_: object) -> None:
        raise AssertionError("solved again")

    monkeypatch.setattr(transducer, "solve", solve)
    again = Instrument(first.plate)
    np.testing.assert_array_equal(again.untouched([22.0]), first.untouched([22.0]))
