"""The benchmark's picture: what is taken from elsewhere is what stands there."""

from __future__ import annotations

from pathlib import Path

from touchd.lab.benchmark.plots import BY_ITS_RECIPE_MM

ROOT = Path(__file__).resolve().parents[4]


def test_the_papers_heads_are_drawn_where_the_reproduction_found_them() -> None:
    page = (ROOT / "docs" / "reproduction.md").read_text()
    full_plate = page[page.index("### On the full plate") : page.index("### On the central")]
    for head, median_mm in BY_ITS_RECIPE_MM.items():
        row = next(line for line in full_plate.splitlines() if line.startswith(f"| {head}, frequency |"))
        assert float(row.split("|")[5]) == median_mm
