"""Pages that are measured part by part: which parts are asked for, and where their data and pictures are put."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from matplotlib.figure import Figure

from touchd.evaluation.plots.session import save
from touchd.training.report.template import Table, write_csv

Part = TypeVar("Part", bound=Callable[..., None])


def picture(page: Path, figure: Figure, name: str) -> None:
    """Save a picture in the folder beside a page that has its name."""
    save(figure, _folder(page) / f"{name}.png")


def data(page: Path, name: str, headings: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Save a table in the same folder, as CSV."""
    write_csv(_folder(page) / f"{name}.csv", Table(headings, [[str(cell) for cell in row] for row in rows]))


def _folder(page: Path) -> Path:
    folder = page.with_suffix("")
    folder.mkdir(exist_ok=True)
    return folder


@contextmanager
def asked(page: Path, what: str, parts: Mapping[str, Part], kept: str) -> Iterator[tuple[Path, dict[str, Part]]]:
    """Read the command line: yield a folder for what is computed on the way, and the parts to be made, by default all.

    Parameters
    ----------
    page : Path
    what : str
        Of the program, for its help.
    parts : mapping of callables
        By name.
    kept : str
        What lies in the folder.
    """
    parser = argparse.ArgumentParser(prog=f"python -m docs.{page.stem}", description=what)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(parts)}")
    parser.add_argument("--keep", type=Path, help=f"folder for {kept}, to be used again")
    given = parser.parse_args()
    if unknown := set(given.parts) - set(parts):
        parser.error(f"no part {', '.join(sorted(unknown))}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        yield folder, {name: part for name, part in parts.items() if not given.parts or name in given.parts}
