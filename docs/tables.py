"""The tables of the measured pages: the rows by which a reader decides, out of the data files beside each page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from touchd.training.report.template import Table, read_csv

DOCS = Path(__file__).resolve().parent
ACCURACY, ROBUSTNESS = DOCS / "accuracy", DOCS / "robustness"
ESTIMATORS = ("field atlas", "network alone")
WORSE = (
    ("the reference", "noise", "60"),
    ("noise of 40 dB", "noise", "40"),
    ("10 K warmer than in training", "temperature", "10"),
    ("1 K warmer than the baseline", "stale", "1"),
    ("channels 0 and 1 dead", "dead", "0+1"),
)
"""What the page shows of the curves: the row's name, the curve, the point."""
TONES = ("-50 dB, within the band", "-40 dB, within the band")


def contacts() -> str:
    """Return failures and errors by kind of contact, whose shape the atlas fits."""
    columns = {"contact": "contact", "wrong_number_per_1000": "wrong number", "off_by_more_than_1_mm_per_1000":
               "over 1 mm off", "median_mm": "median", "p95_mm": "p95", "within_1_sigma": "within sigma",
               "faces_told": "size told"}  # fmt: skip
    found = read_csv(ACCURACY / "contacts.csv").pick(columns=list(columns))
    rows = [[*row[:-2], *(f"{float(share):.0%}" for share in row[-2:])] for row in found.rows]
    return Table(list(columns.values()), rows).markdown()


def worse() -> str:
    """Return what each estimator makes of a plate that is worse in one way."""
    rows = []
    for name, curve, point in WORSE:
        found = {row[1]: row[2:] for row in read_csv(ROBUSTNESS / f"{curve}.csv").rows if row[0] == point}
        rows.append([name, *(_cell(*found[one]) if one in found else "" for one in ESTIMATORS)])
    return Table(("median / p95, mm", *ESTIMATORS), rows).markdown()


def _cell(median: str, p95: str, placed: str) -> str:
    errors = f"{median} / {p95}" if median else "none placed"
    return errors if placed in ("", "100%") else f"{errors} ({placed})"


def limit() -> str:
    """Return how many positions bad inputs make, and how many of them are wrong."""
    tones = [row for row in read_csv(ROBUSTNESS / "tones.csv").rows if row[0] in TONES]
    rows = (*read_csv(ROBUSTNESS / "limit.csv").rows, *tones)
    published, wrong = (sum(int(row[at]) for row in rows) for at in (-5, -4))
    return f"Published: {published:,} positions; wrong: {wrong}."


def float64() -> str:
    """Return what single precision and early stopping cost, in a sentence."""
    found = read_csv(ROBUSTNESS / "float64.csv")
    *scenes, every = (dict(zip(found.headings, row, strict=True)) for row in found.rows)
    same = sum(scene["same_events"] == "yes" for scene in scenes)
    return (
        f"{same} of {len(scenes)} scenes have the same events; rounding moves {int(every['places']):,} places by at "
        f"most {every['rounding_most_mm']} mm, stopping early by {every['truncation_median_mm']} mm in the median, at "
        f"most {every['truncation_most_mm']} mm or {every['truncation_most_sigma']} sigma."
    )


BLOCKS: dict[Path, tuple[Callable[[], str], ...]] = {
    DOCS / "accuracy.md": (contacts,),
    DOCS / "robustness.md": (worse, limit, float64),
}
"""By page: its tables, each in the block of its name."""
