"""Work that goes on in the next frame: generators that yield what each piece of it has cost.

Cost is counted and never timed, so that a recording gives the same contacts at any speed. The unit is one look-up of
one finger's field in a fit of several: about 0.03 ms.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")
Steps = Generator[float, None, T]
"""Yields the cost of each piece, and returns the result."""

SHAPE_COST = 2.0
"""Cost of one step of one contact whose shape is fitted too, in look-ups."""
SCAN_COST, REST_COST = 5.0, 1.0
"""Cost of a scan of the atlas, whose tables are seldom in a cache, and of a residual."""


def finish(steps: Steps[T]) -> T:
    """Take all pieces of work at once."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            found: T = end.value
            return found
