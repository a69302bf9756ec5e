"""Pages as templates: a Markdown file beside the program, its fields filled with what was measured."""

from __future__ import annotations

import re
from pathlib import Path
from string import Template


def filled(path: Path, fields: dict[str, object]) -> str:
    """Return a template with each `$field` filled in.

    A paragraph or list item with a field that is None or empty, because it was not measured, is left out, and a heading
    with nothing left below it. Lines of a paragraph are joined, so that the template may be wrapped.

    Parameters
    ----------
    path : Path
        Markdown with the fields of `string.Template`.
    fields : dict
        Values by name; a name that the template has and this lacks raises KeyError.
    """
    missing = {name for name, value in fields.items() if value in (None, "")}
    kept: list[str] = []
    level = 1  # of the heading that follows; none may follow at a lower level without text between
    for paragraph in reversed(path.read_text("utf-8").strip().split("\n\n")):
        items = [i for i in re.split(r"\n(?=- )", paragraph) if not missing & set(Template(i).get_identifiers())]
        depth = len(paragraph) - len(paragraph.lstrip("#"))
        if not items or (depth and level and depth >= level):
            continue
        level = depth
        kept.append("\n".join(" ".join(map(str.strip, item.splitlines())) for item in items))
    return Template("\n\n".join(reversed(kept))).substitute(fields) + "\n"


def table(headings: tuple[str, ...], rows: list[list[str]], left: set[int] | None = None) -> str:
    """Return a Markdown table, empty without rows; the columns `left`, by default the first, stand to the left."""
    if not rows:
        return ""
    rule = "".join("---|" if i in (left or {0}) else "---:|" for i in range(len(headings)))
    lines = ["| " + " | ".join(headings) + " |", "|" + rule]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])
