"""Asks the source for as many frames as the scene needs: few of an untouched plate, all from the first touch on."""

from __future__ import annotations

from touchd.config.schema import DeviceSettings
from touchd.outcome import Outcome
from touchd.sources.source import AdjustableSource, Source

QUIET_NS = 2_000_000_000
"""The plate is idle after this time without a frame that opens the gate: most pauses between touches are shorter."""
SCREEN_OFF_HZ = 10
"""Keeps the baseline with the plate while nobody can touch anything."""
_SCREEN_OFF = Outcome.SCREEN_OFF


class ScanRate:
    """Decides the frame rate by what came of each frame.

    Parameters
    ----------
    source : Source
        One that is no AdjustableSource keeps its rate.
    settings : DeviceSettings
    """

    def __init__(self, source: Source, settings: DeviceSettings) -> None:
        self._source = source if isinstance(source, AdjustableSource) else None
        self._full_hz = self.rate_hz = settings.rate_hz
        self._idle_hz = min(settings.idle_rate_hz, settings.rate_hz)
        self._off_hz = min(SCREEN_OFF_HZ, self._idle_hz)
        self._busy_ns = 0
        self.wanted = False
        """Whether somebody wants all frames."""

    def touched(self, t_ns: int, outcome: Outcome) -> None:
        """Take the time of a frame that is not UNTOUCHED, and its outcome.

        Call it once the frame's messages are sent: the request takes a moment.
        """
        self._busy_ns = t_ns
        rate_hz = self._off_hz if outcome is _SCREEN_OFF and not self.wanted else self._full_hz
        if rate_hz != self.rate_hz:
            self._ask(rate_hz)

    def untouched(self, t_ns: int) -> None:
        """Take the time of an untouched frame; not every one."""
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
        if self._source is not None:
            self._source.set_rate(rate_hz)
