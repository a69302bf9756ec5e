"""How long a training will go on, from its beginning: one estimate for the field and all epochs."""

from __future__ import annotations

import time
from collections.abc import Callable

# What either costs was measured side by side, on two cores at the source paper's 4,483 touches: only their ratio
# counts, until epochs have been timed. The field solves systems of n unknowns, an epoch shows n touches.
TOUCHES = 4483
FIELD_S = 50.0
FIELD_POWER = 2.5
EPOCH_S = 0.83
SURE = 0.1
"""Share of the field after which its own pace is trusted."""


class TimeLeft:
    """Estimates the time left from the steps done.

    Parameters
    ----------
    touches : int
        Touches to train on.
    epochs : int
    clock : callable
        Returns seconds that only ever grow.
    """

    def __init__(self, touches: int, epochs: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._epochs = epochs
        self._clock = clock
        self._began = clock()
        self._what = ""
        size = touches / TOUCHES
        # An epoch has a least number of steps, so few touches do not make it shorter.
        self._epochs_to_field = epochs * EPOCH_S * max(1.0, size) / (FIELD_S * size**FIELD_POWER)

    def after(self, what: str, done: int, steps: int) -> float | None:
        """Return the seconds left after a step of the `field` or the `network`, None while nobody can know."""
        now = self._clock()
        if what != self._what and self._what:
            self._began = now  # this step's own time is missing from the pace of the first few
            self._what, self._before = what, done
            return None
        if not self._what:
            self._what, self._before = what, 0
        counted = done - self._before
        if counted <= 0 or (what == "field" and done < SURE * steps):
            return None
        each_s = (now - self._began) / counted
        left_s = each_s * (steps - done)
        return left_s + each_s * steps * self._epochs_to_field if what == "field" else left_s


def say(left_s: float | None) -> str:
    """Return a time left as one would say it."""
    if left_s is None:
        return ""
    if left_s < 1:
        return "done"
    return f"{left_s:.0f} s left" if left_s < 100 else f"{left_s / 60:.0f} min left"
