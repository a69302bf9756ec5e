"""The tables of the measured pages: the rows by which a reader decides, out of the data files beside each page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from touchd.training.report.template import Table, read_csv, table

DOCS = Path(__file__).resolve().parent
ACCURACY, ROBUSTNESS = DOCS / "accuracy", DOCS / "robustness"
ESTIMATORS = ("field atlas", "network alone")
WORSE = (
    ("the reference", "noise", "60"),
    ("noise of 40 dB", "noise", "40"),
    ("10 K warmer than in training", "temperature", "10"),
    ("1 K warmer than the baseline", "stale", "1"),
    ("channel 0 at half its gain", "gain", "0.5"),
    ("channels 0 and 1 dead", "dead", "0+1"),
    ("trained on 1000 touches", "learning", "1000"),
)
"""What the page shows of the curves: the row's name, the curve, the point."""
INPUTS = (
    "frozen: the first frame again and again",
    "clipped: 10 % of the samples",
    "offset: 50 % of full scale",
    "one channel dead",
    "one channel inverted",
    "bursts",
    "signal to noise: 30 dB",
)
TONES = ("-50 dB, within the band", "-40 dB, within the band")


def noise() -> str:
    """Return error, bound and standard error by noise."""
    columns = {"noise_db": "noise, dB", "median_mm": "median", "p95_mm": "p95",
               "bound_mm": "Cramer-Rao bound", "within_1_sigma": "within sigma", "placed": "placed"}  # fmt: skip
    return _renamed(read_csv(ACCURACY / "noise.csv"), columns)


def contacts() -> str:
    """Return failures and errors by kind of contact, whose shape the atlas fits."""
    columns = {"contact": "contact", "wrong_number_per_1000": "wrong number", "off_by_more_than_1_mm_per_1000":
               "over 1 mm off", "median_mm": "median", "p95_mm": "p95", "within_1_sigma": "within sigma",
               "faces_told": "size told"}  # fmt: skip
    found = read_csv(ACCURACY / "contacts.csv").pick(columns=list(columns))
    rows = [[*row[:-2], *(f"{float(share):.0%}" for share in row[-2:])] for row in found.rows]
    return table(list(columns.values()), rows)


def worse() -> str:
    """Return what each estimator makes of a plate that is worse in one way."""
    rows = []
    for name, curve, point in WORSE:
        found = {row[1]: row[2:] for row in read_csv(ROBUSTNESS / f"{curve}.csv").rows if row[0] == point}
        rows.append([name, *(_cell(*found[one]) if one in found else "" for one in ESTIMATORS)])
    return table(("median / p95, mm", *ESTIMATORS), rows)


def _cell(median: str, p95: str, placed: str) -> str:
    errors = f"{median} / {p95}" if median else "none placed"
    return errors if placed in ("", "100%") else f"{errors} ({placed})"


def limit() -> str:
    """Return how many taps are found among bad inputs."""
    rows = read_csv(ROBUSTNESS / "limit.csv").rows
    moments = list(dict.fromkeys(row[1] for row in rows))
    found = {(row[0], row[1]): f"{row[5]} of {row[6]}" for row in rows}
    tones = [row for row in read_csv(ROBUSTNESS / "tones.csv").rows if row[0] in TONES]
    shown = [[name, *(found[name, moment] for moment in moments)] for name in INPUTS]
    shown += [[f"a tone, {row[0]}", f"{row[4]} of {row[5]}", "", ""] for row in tones]
    published, wrong = (sum(int(row[at]) for row in (*rows, *tones)) for at in (-5, -4))
    return table(("taps found", *moments), shown) + f"\n\nPublished: {published:,} positions; wrong: {wrong}."


def float64() -> str:
    """Return what single precision and early stopping cost."""
    found = read_csv(ROBUSTNESS / "float64.csv")
    *scenes, every = (dict(zip(found.headings, row, strict=True)) for row in found.rows)
    same = sum(scene["same_events"] == "yes" for scene in scenes)
    return table(("result", ""), [
        ["scenes with the same events in float64", f"{same} of {len(scenes)}"],
        ["rounding, at most", f"{every['rounding_most_mm']} mm, of {int(every['places']):,} places"],
        ["stopping early", f"{every['truncation_median_mm']} mm in the median, {every['truncation_most_mm']} mm at "
         f"most; at most {every['truncation_most_sigma']} sigma"],
    ])  # fmt: skip


def _renamed(found: Table, columns: dict[str, str]) -> str:
    return table(list(columns.values()), found.pick(columns=list(columns)).rows)


BLOCKS: dict[Path, tuple[Callable[[], str], ...]] = {
    DOCS / "accuracy.md": (noise, contacts),
    DOCS / "robustness.md": (worse, limit, float64),
}
"""By page: its tables, each in the block of its name."""
