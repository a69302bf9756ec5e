"""The page of the reproduction says what the figures beside it say."""

from __future__ import annotations

from pathlib import Path

from touchd.lab.reproduction.report import Figures, load, store
from touchd.training.report.template import Table


def test_figures_are_read_as_stored(tmp_path: Path) -> None:
    """Facts and whole tables come back as they were written, commas and all."""
    found = Figures(
        {"source": "a plate, ±1 K", "given": True}, {"shares": Table(["share", "kNN"], [["1, all", "96.2%"]])}
    )
    store(found, tmp_path)
    assert load(tmp_path) == found
