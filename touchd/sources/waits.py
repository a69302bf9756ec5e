"""How long a thread that reads a device waits."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Waits:
    """How long the thread that reads the device waits, seconds."""

    read_s: float = 0.1
    """Timeout of a read: while no frame comes, the thread notices `close` this late."""
    retry_s: float = 0.1
    """Shortest interval between two looks for a device."""
    max_retry_s: float = 0.5
    """Longest interval; the intervals grow from look to look."""
    hang_s: float = 10.0
    """A thread that is silent this long hangs in the kernel, and only a new process helps."""


WAITS = Waits()
