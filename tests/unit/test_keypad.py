"""A layout of keys is taken only if somebody can type on it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from touchd.errors import ConfigError
from touchd.files import MOST_TEXT_BYTES
from touchd.frame import Plate
from touchd.keypad import PHONE, load_layout

PLATE = Plate(width_mm=200.0, height_mm=100.0)
Rectangle = tuple[str, float, float, float, float]


def layout(folder: Path, *keys: Rectangle) -> Path:
    path = folder / "keys.toml"
    names = ("x_mm", "y_mm", "width_mm", "height_mm")
    tables = [f'[[key]]\nname = "{name}"\n' + "".join(f"{n} = {v}\n" for n, v in zip(names, numbers, strict=True))
              for name, *numbers in keys]  # fmt: skip
    path.write_text("\n".join(tables))
    return path


def test_shipped() -> None:
    """The shipped layout fits a plate of 200 x 200 mm."""
    assert len(load_layout(PHONE, Plate(width_mm=200, height_mm=200)).key) == 12


def test_edge_to_edge(tmp_path: Path) -> None:
    """Keys may fill the plate and share their edges."""
    keys = load_layout(layout(tmp_path, ("a", 0, 0, 66.6, 100), ("b", 66.6, 0, 133.4, 100)), PLATE)
    assert keys.at(66.5, 5) == "a"
    assert keys.at(66.7, 5) == "b"


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ([("a", 0, 0, 500, 20)], r"beyond the plate of 200 x 100 mm: 'a'"),
        ([("a", -1, 0, 20, 20), ("b", 30, 0, 20, 20), ("c", 60, 90, 20, 20)], r"mm: 'a', 'c'"),
        ([("a", 0, 0, 50, 20), ("b", 60, 0, 20, 20), ("c", 79, 19, 20, 20)], r"the keys 'b' and 'c' overlap"),
        ([("a", 0, 0, 50, 50), ("b", 10, 10, 20, 20)], r"the keys 'a' and 'b' overlap"),
        ([("a", 0, 0, 20, 20), ("a", 30, 0, 20, 20)], r"two keys are named 'a'"),
        ([("a", 0, 0, 0, 20)], r"key\.0\.width_mm"),
        ([("", 0, 0, 10, 20)], r"key\.0\.name"),
        ([], r"key: Field required"),
    ],
)
def test_refused(tmp_path: Path, keys: list[Rectangle], message: str) -> None:
    """Keys beyond the plate, on top of each other, or without a name of their own are refused, by name."""
    with pytest.raises(ConfigError, match=message) as caught:
        load_layout(layout(tmp_path, *keys), PLATE)
    assert caught.value.where == str(tmp_path / "keys.toml")
    assert caught.value.fix


def test_too_many(tmp_path: Path) -> None:
    """A layout that would hold the start up for half a minute is refused."""
    with pytest.raises(ConfigError, match="at most 1000"):
        load_layout(layout(tmp_path, *((str(i), i, 0, 0.5, 1) for i in range(1001))))


@pytest.mark.parametrize("content", [b"a = " + b"1" * 5000, b"a = " + b"[" * 5000, b"\xff", b"[", b"key = 3"])
def test_no_layout(tmp_path: Path, content: bytes) -> None:
    """A file that is no layout is refused, and so are a folder, a pipe and what is too long for one."""
    (tmp_path / "keys.toml").write_bytes(content)
    (tmp_path / "long.toml").write_bytes(b"#" * (MOST_TEXT_BYTES + 1))
    os.mkfifo(tmp_path / "pipe.toml")
    for path in (tmp_path / "keys.toml", tmp_path, tmp_path / "long.toml", tmp_path / "pipe.toml"):
        with pytest.raises(ConfigError) as refused:
            load_layout(path)
        assert "keypad.layout" not in str(refused.value)  # it may have been named by an option
