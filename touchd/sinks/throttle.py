"""A log line that strangers can cause, at most once a second."""

from __future__ import annotations

import time
from collections.abc import Callable

import structlog

log = structlog.get_logger()

PERIOD_S = 1.0


class Throttle:
    """Logs warnings of one kind at most once a second; `unlogged` counts those left out in between."""

    def __init__(self, event: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._event, self._clock = event, clock
        self._next_s = -float("inf")
        self._unlogged = 0

    def warn(self, **fields: object) -> bool:
        """Log the event with these fields, or count it; return whether it was logged."""
        now_s = self._clock()
        if now_s < self._next_s:
            self._unlogged += 1
            return False
        self._next_s = now_s + PERIOD_S
        if self._unlogged:
            fields["unlogged"] = self._unlogged
            self._unlogged = 0
        log.warning(self._event, **fields)
        return True
