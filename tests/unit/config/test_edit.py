"""Keys are set in a configuration file without a change to anything else."""

from __future__ import annotations

from pathlib import Path

import pytest

from touchd.config.edit import set_keys, with_keys
from touchd.config.load import load
from touchd.errors import OutputError

KEYS = {"screen_mm": "[1, 2, 30, 40]", "rotate": "90"}


def test_the_file_keeps_all_else() -> None:
    """Only the keys of the mapping change; comments, order and other tables stay."""
    text = "# mine\n[bus]\n# rotate = 3\nhigh_water_mark = 5\n\n[input] # here\n# Default: 0\nrotate = 0\n\n[log]\n"
    changed = with_keys(text, "input", KEYS)
    assert changed == text.replace("rotate = 0\n", "rotate = 90\n").replace(
        "[input] # here\n", "[input] # here\nscreen_mm = [1, 2, 30, 40]\n"
    )
    assert with_keys(changed, "input", KEYS) == changed
    assert with_keys("", "input", KEYS) == "[input]\nrotate = 90\nscreen_mm = [1, 2, 30, 40]\n"
    assert with_keys("# mine\n", "input", KEYS) == "# mine\n\n[input]\nrotate = 90\nscreen_mm = [1, 2, 30, 40]\n"


@pytest.mark.parametrize("text", ["\ufeff[input]\nborder = 'lift'\n", "[ input ]\nborder = 'lift'\n"])
def test_the_table_is_found(tmp_path: Path, text: str) -> None:
    """A byte order mark before the first table, or spaces around its name, hide no table."""
    file = tmp_path / "touchd.toml"
    file.write_text(text)
    set_keys(file, "input", KEYS)
    found = load(file).input
    assert (found.screen_mm, found.rotate, found.border) == ((1.0, 2.0, 30.0, 40.0), 90, "lift")


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    """The file that a symbolic link names takes the keys."""
    link, file = tmp_path / "touchd.toml", tmp_path / "mine.toml"
    link.symlink_to(file)
    for text in (None, "# mine\n"):
        if text:
            file.write_text(text)
        set_keys(link, "input", KEYS)
        assert link.is_symlink()
        assert load(file).input.rotate == 90


def test_an_unusual_file_is_left() -> None:
    """A list over several lines is not broken: the user is asked to write the lines by hand."""
    with pytest.raises(OutputError, match="by hand"):
        with_keys("[input]\nscreen_mm = [\n 1, 2,\n 3, 4]\n", "input", KEYS)
