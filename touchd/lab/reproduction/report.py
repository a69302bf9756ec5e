"""Write the report in Markdown, and all figures as files beside its plots."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from touchd.files import replacing
from touchd.lab.reproduction import paper
from touchd.training.report.template import Table, read_csv, render, write_csv

TEMPLATE = Path(__file__).with_name("report.md.j2")
SHOWN_HEADS, SHOWN_SHARES = ("R, frequency", "C-10, frequency"), ("100%", "20%")
SHARES = ("share", "network", "kNN", "paper: network", "paper: kNN")


class Figures(NamedTuple):
    """What a report says: facts by name, and whole tables by name."""

    facts: dict[str, object]
    tables: dict[str, Table]


def page(found: Figures, folder: str) -> str:
    """Return the page, with its plots and whole tables in `folder` beside it: of each table the decisive rows."""
    tables = found.tables
    shown = {
        "heads": _heads(tables["full-plate"], tables["central"]),
        "shares": tables["shares"].pick(SHOWN_SHARES, SHARES),
    }
    if "circle" in tables:
        shown["circle"] = tables["circle"].pick(columns=("model", "mean", "sd", "paper: mean ± sd"))
        shown["beaten"] = tables["beaten"]
    return render(
        TEMPLATE, pictures=folder, paper=paper, **found.facts,
        **{name: table.markdown() for name, table in shown.items()},
    )  # fmt: skip


def _heads(full: Table, central: Table) -> Table:
    """Return the heads that decide, on both areas."""
    columns = ("head, domain", "mean", "sd", "perfect")
    rows = []
    for ours, theirs, said in zip(
        full.pick(SHOWN_HEADS, columns).rows, central.pick(SHOWN_HEADS, columns).rows,
        full.pick(SHOWN_HEADS, ("paper: mean ± sd",)).rows, strict=True,
    ):  # fmt: skip
        rows.append([ours[0], *(f"{mean} ± {sd}, {best}" for _, mean, sd, best in (ours, theirs)), *said])
    heading = "mean ± sd, perfect"
    return Table(("head, domain", f"full plate: {heading}", f"central 11 x 11 cm: {heading}", "paper: mean ± sd"), rows)


def store(found: Figures, folder: Path) -> None:
    """Write facts and tables into a folder."""
    text = json.dumps(found.facts, indent=1, ensure_ascii=False)
    with replacing(folder / "facts.json") as file:
        file.write(text.encode() + b"\n")
    for name, table in found.tables.items():
        write_csv(folder / f"{name}.csv", table)


def load(folder: Path) -> Figures:
    """Read what `store` wrote."""
    tables = {path.stem: read_csv(path) for path in folder.glob("*.csv")}
    return Figures(json.loads((folder / "facts.json").read_text("utf-8")), tables)
