"""Where to tap: an order that covers the plate early, so that one may stop at any time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

EDGE = 0.1
"""Share of a side that targets keep from each edge."""
REPEAT_EVERY, REPEAT_BACK = 5, 3
"""One target in five repeats an earlier one: two taps at one place tell how well a person hits."""
AGAIN_AFTER = 4
"""A target that was missed comes again after as many good taps."""
_PLASTIC = 1.32471795724474602596


def target_mm(index: int, width_mm: float, height_mm: float) -> tuple[float, float]:
    """Return the target of this number.

    The points of Roberts' R2 sequence (2018): of low discrepancy from the first on.
    """
    if index % REPEAT_EVERY == REPEAT_EVERY - 1:
        index -= REPEAT_BACK
    x, y = ((0.5 + (index + 1) / _PLASTIC**k) % 1 for k in (1, 2))
    return round(width_mm * (EDGE + (1 - 2 * EDGE) * x), 1), round(height_mm * (EDGE + (1 - 2 * EDGE) * y), 1)


def next_number(again: Iterable[Sequence[int]], upcoming: int, good: int) -> int:
    """Return the number of the target to tap after so many good taps: the first due one of `again`, else `upcoming`.

    `again` holds numbers of targets, each with the count of good taps from which on it is due.
    """
    return next((number for number, due in again if good >= due), upcoming)
