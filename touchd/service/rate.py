"""Asks the source for as many frames as the scene needs: few of an untouched plate, all from the first touch on."""

from __future__ import annotations

import structlog

from touchd.config.schema import DeviceSettings
from touchd.outcome import Outcome
from touchd.sources.source import Source

log = structlog.get_logger()

QUIET_NS = 500_000_000
"""The plate is idle after this time without a frame that opens the gate: the pauses of a double tap are shorter, and a
longer one costs the next touch 2 ms at the idle rate."""
SCREEN_OFF_HZ = 10
"""Keeps the baseline with the plate while nobody can touch anything."""
_AGAIN_NS = 5_000_000_000
"""A device that did not answer is asked again after this time: the frames stand still while it is waited for."""
_SCREEN_OFF = Outcome.SCREEN_OFF


class ScanRate:
    """Decides the frame rate by what came of each frame; a source that has one rate alone keeps it."""

    def __init__(self, source: Source, settings: DeviceSettings) -> None:
        self._source = source
        self._full_hz = self.rate_hz = settings.rate_hz
        self._idle_hz = min(settings.idle_rate_hz, settings.rate_hz)
        self._off_hz = min(SCREEN_OFF_HZ, self._idle_hz)
        self._busy_ns = self._t_ns = 0
        self._unheard_ns: int | None = None  # when the device did not answer
        self.wanted = False
        """Whether somebody wants all frames."""

    def touched(self, t_ns: int, outcome: Outcome) -> None:
        """Take the time of a frame that is not UNTOUCHED, and its outcome.

        Call it once the frame's messages are sent: the request takes a moment.
        """
        self._busy_ns = self._t_ns = t_ns
        rate_hz = self._off_hz if outcome is _SCREEN_OFF and not self.wanted else self._full_hz
        if rate_hz != self.rate_hz:
            self._ask(rate_hz)

    def tick(self, t_ns: int) -> None:
        """Take the time of a frame; not every one."""
        self._t_ns = t_ns
        if self._unheard_ns is not None and t_ns - self._unheard_ns >= _AGAIN_NS:
            self._ask(self.rate_hz)
        if self.wanted:
            self.wake()
        elif self.rate_hz != self._idle_hz and not 0 <= t_ns - self._busy_ns < QUIET_NS:
            self._ask(self._idle_hz)

    def wake(self) -> None:
        """Ask for all frames now: the screen comes on."""
        if self.rate_hz != self._full_hz:
            self._ask(self._full_hz)

    def _ask(self, rate_hz: int) -> None:
        self.rate_hz = rate_hz
        heard = self._source.set_rate(rate_hz)
        if not heard and self._unheard_ns is None:
            log.warning("the device did not take another frame rate; it is asked again", rate_hz=rate_hz)
        self._unheard_ns = None if heard else self._t_ns
