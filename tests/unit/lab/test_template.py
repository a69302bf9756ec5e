"""A page is its template with what was measured, and without what was not."""

from __future__ import annotations

from pathlib import Path

import pytest

from touchd.lab.template import filled, table

TEMPLATE = """
# $title

Wrapped
prose of $count touches.

- one: $one
  goes on
- two: $two

## Nothing below

### Nor here

$two

## The end

$rows
"""
FIELDS: dict[str, object] = {"title": "Page", "count": 0, "one": "1", "two": None, "rows": "| $1 |"}


@pytest.fixture
def page(tmp_path: Path) -> Path:
    path = tmp_path / "page.md"
    path.write_text(TEMPLATE)
    return path


def test_what_was_not_measured(page: Path) -> None:
    """A paragraph, a list item and a heading without a value are left out; a value is not read as a template."""
    assert filled(page, FIELDS) == (
        "# Page\n\nWrapped prose of 0 touches.\n\n- one: 1 goes on\n\n## The end\n\n| $1 |\n"
    )


def test_a_field_that_nobody_fills(page: Path) -> None:
    """A field without a value given is an error, not a hole in the page."""
    with pytest.raises(KeyError, match="count"):
        filled(page, {"title": "Page", "one": 1, "two": 2, "rows": ""})


def test_table() -> None:
    """Names stand to the left, numbers to the right; no rows, no table."""
    assert table(("name", "mm"), [["a", "1"]]) == "| name | mm |\n|---|---:|\n| a | 1 |"
    assert table(("name", "mm"), []) == ""
