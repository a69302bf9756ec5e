"""Keys are set in a configuration file without a change to anything else."""

from __future__ import annotations

import pytest

from touchd.config.edit import with_keys
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


def test_an_unusual_file_is_left() -> None:
    """A list over several lines is not broken: the user is asked to write the lines by hand."""
    with pytest.raises(OutputError, match="by hand"):
        with_keys("[input]\nscreen_mm = [\n 1, 2,\n 3, 4]\n", "input", KEYS)
