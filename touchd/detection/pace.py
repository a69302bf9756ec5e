"""How far apart frames are, so that what is stated for a number of frames holds for their time at any rate."""

from __future__ import annotations

USUAL_NS = 8_000_000
"""From frame to frame at 125 a second. Settings that count frames count frames of this length."""
_SLOW_NS = 128_000_000
SHORTEST_NS, LONGEST_NS = 500_000, 200_000_000
_LIKE = 1.5
"""A step within this factor of the period in use is no other rate: a clock's error, or a frame that comes late."""
_STEPS = 4
"""Steps in a row that tell another rate; lost frames make one."""


class Pace:
    """The time from frame to frame. It stays as it is while frames come at about the same rate."""

    def __init__(self) -> None:
        self.period_ns = USUAL_NS
        self._steps: list[int] = []
        self.slow_every = _SLOW_NS // USUAL_NS
        """What follows slowly takes one of so many frames: one in 128 ms."""
        self._set_limits()

    def update(self, step_ns: int) -> bool:
        """Take the time since the last frame, and return whether the rate has changed.

        A step between `low_ns` and `high_ns` need not be taken.
        """
        if step_ns <= 0 or self.period_ns / _LIKE < step_ns < self.period_ns * _LIKE:
            self._steps.clear()
        else:
            self._steps.append(step_ns)
        changed = len(self._steps) == _STEPS
        if changed:
            self.period_ns = min(max(sum(self._steps) // _STEPS, SHORTEST_NS), LONGEST_NS)
            self.slow_every = max(1, round(_SLOW_NS / self.period_ns))
            self._steps.clear()
        self._set_limits()
        return changed

    def _set_limits(self) -> None:
        """Limit what need not be taken: in doubt every step is."""
        self.low_ns, self.high_ns = (0.0, 0.0) if self._steps else (self.period_ns / _LIKE, self.period_ns * _LIKE)
