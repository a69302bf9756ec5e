"""Render a Markdown page from the Jinja template beside the module that fills it; keep its tables as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from touchd.files import replacing


class Table(NamedTuple):
    """Headings and rows of text; the first column holds names."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""

    def pick(self, names: Sequence[str] = (), columns: Sequence[str] = ()) -> Table:
        """Return the rows of some names, and some of the columns; all by default."""
        at = [self.headings.index(column) for column in columns or self.headings]
        rows = [[row[i] for i in at] for row in self.rows if not names or row[0] in names]
        return Table([self.headings[i] for i in at], rows)

    def markdown(self) -> str:
        """Format the table in Markdown, with columns of numbers aligned right."""
        text = {i for i in range(len(self.headings)) if not all(_is_number(row[i]) for row in self.rows)}
        rule = "|" + "|".join("---" if i in text else "---:" for i in range(len(self.headings))) + "|"
        lines = ["| " + " | ".join(row) + " |" for row in (self.headings, *self.rows)]
        return "\n".join([lines[0], rule, *lines[1:]])


def render(template: Path, **values: object) -> str:
    """Fill a template; the filter `as` formats a number by Python's format specification.

    Raises jinja2.UndefinedError if the template names a value that is not given.
    """
    environment = Environment(  # noqa: S701 - Markdown has no entities to escape
        loader=FileSystemLoader(template.parent), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters["as"] = format
    return environment.get_template(template.name).render(values)


def write_csv(path: Path, found: Table) -> None:
    """Write a table as CSV, its headings in the first line."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows([found.headings, *found.rows])
    with replacing(path) as file:
        file.write(text.getvalue().encode())


def read_csv(path: Path) -> Table:
    """Read a table that `write_csv` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        headings, *rows = csv.reader(file)
    return Table(headings, rows)


def _is_number(text: str) -> bool:
    return text == "-" or text.replace(",", "").rstrip("%").replace("+", "-").lstrip("-").replace(".", "", 1).isdigit()
