"""Render a Markdown page from the Jinja template beside the module that fills it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined


def render(template: Path, **values: object) -> str:
    """Fill a template; the filter `as` formats a number by Python's format specification.

    Raises
    ------
    jinja2.UndefinedError
        The template names a value that is not given.
    """
    environment = Environment(  # noqa: S701 - Markdown has no entities to escape
        loader=FileSystemLoader(template.parent), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters["as"] = format
    return environment.get_template(template.name).render(values)


def table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table, with columns of numbers aligned right."""
    text = {i for i in range(len(headings)) if not all(_is_number(row[i]) for row in rows)}
    rule = "|" + "|".join("---" if i in text else "---:" for i in range(len(headings))) + "|"
    lines = ["| " + " | ".join(headings) + " |", rule]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _is_number(text: str) -> bool:
    return text == "-" or text.replace(",", "").rstrip("%").replace("+", "-").lstrip("-").replace(".", "", 1).isdigit()
