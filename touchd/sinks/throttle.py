"""A log line that strangers can cause, at most once a second, and once a minute if they go on."""

from __future__ import annotations

import time
from collections.abc import Callable

import structlog

log = structlog.get_logger()

PERIOD_S = 1.0
LONGEST_S = 60.0


class Throttle:
    """Logs warnings of one kind at most once a second; `unlogged` counts those left out in between.

    While they go on, the pause doubles up to a minute: a check that knocks every few seconds does so for years. After a
    minute without any it is a second again.
    """

    def __init__(self, event: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._event, self._clock = event, clock
        self._last_s = self._next_s = -float("inf")
        self._pause_s = PERIOD_S
        self._unlogged = 0

    def warn(self, **fields: object) -> bool:
        """Log the event with these fields, or count it; return whether it was logged."""
        now_s = self._clock()
        if now_s - self._last_s >= LONGEST_S:
            self._pause_s = PERIOD_S
        self._last_s = now_s
        if now_s < self._next_s:
            self._unlogged += 1
            return False
        self._next_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, LONGEST_S)
        if self._unlogged:
            fields["unlogged"] = self._unlogged
            self._unlogged = 0
        log.warning(self._event, **fields)
        return True
