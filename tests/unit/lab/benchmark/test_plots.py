"""The benchmark's picture: what is taken from elsewhere is what stands there."""

from __future__ import annotations

from pathlib import Path

from touchd.lab.benchmark.plots import BY_ITS_RECIPE_MM
from touchd.training.report.template import read_csv

ROOT = Path(__file__).resolve().parents[4]


def test_the_papers_heads_are_drawn_where_the_reproduction_found_them() -> None:
    full_plate = read_csv(ROOT / "docs" / "reproduction" / "full-plate.csv")
    for head, median_mm in BY_ITS_RECIPE_MM.items():
        ((found,),) = full_plate.pick((f"{head}, frequency",), ("median",)).rows
        assert float(found) == median_mm
