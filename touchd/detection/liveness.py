"""Frames may come and measure nothing: repeated ones, a test pattern, chirps that were not sent."""

from __future__ import annotations

SILENT_NS = 100_000_000
"""Contacts are lifted this long after the last measurement, while frames come that are none."""


class Liveness:
    """Knows the time of the last measurement, and what the frames since then are instead."""

    def __init__(self) -> None:
        self.measured_ns = 0
        """Time of the last measurement; set it with each."""
        self._silent_since_ns = -1
        self._fault = ""

    def is_silent(self, t_ns: int, fault: str) -> bool:
        """Take a frame that is no measurement, with the reason; return whether there was none for 100 ms."""
        if not self.measured_ns:
            self.measured_ns = t_ns  # the first frame of all
        if t_ns - self.measured_ns < SILENT_NS:
            return False
        self._silent_since_ns, self._fault = self.measured_ns, fault
        return True

    @property
    def fault(self) -> str | None:
        """Why the frames are no measurements, for a person; None if they are, or were within 100 ms."""
        return self._fault if self._silent_since_ns == self.measured_ns else None
