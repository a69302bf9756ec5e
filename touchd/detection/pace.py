"""How far apart frames are, so that what is stated for a number of frames holds for their time at any rate."""

from __future__ import annotations

USUAL_NS = 8_000_000
"""From frame to frame at 125 a second. Settings that count frames count frames of this length."""
SHORTEST_NS, LONGEST_NS = 500_000, 200_000_000
_LIKE = 1.5
"""A step within this factor of the period in use is no other rate: a clock's error, or a frame that comes late."""
_STEPS = 4
"""Steps in a row that tell another rate; lost frames make one."""


class Pace:
    """The time from frame to frame. It stays as it is while frames come at about the same rate."""

    period_ns: int
    low_ns: float
    high_ns: float
    doubtful: bool
    """Whether the last step was another one."""

    def __init__(self) -> None:
        self._steps: list[int] = []
        self._set(USUAL_NS)

    def update(self, step_ns: int) -> bool:
        """Take the time since the last frame, and return whether the rate has changed.

        A step between `low_ns` and `high_ns` need not be taken unless the pace is `doubtful`.
        """
        if step_ns <= 0 or self.low_ns < step_ns < self.high_ns:
            self._steps.clear()
        else:
            self._steps.append(step_ns)
        self.doubtful = bool(self._steps)
        if len(self._steps) < _STEPS:
            return False
        self._set(min(max(sum(self._steps) // _STEPS, SHORTEST_NS), LONGEST_NS))
        return True

    def _set(self, period_ns: int) -> None:
        self._steps.clear()
        self.doubtful = False
        self.period_ns = period_ns
        self.low_ns = period_ns / _LIKE
        self.high_ns = period_ns * _LIKE
