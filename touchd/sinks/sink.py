"""Where events go. No reader can make a sink block or raise."""

from __future__ import annotations

from typing import Protocol

from touchd.event import Event


class Sink(Protocol):
    """What the service calls."""

    def wants(self, topic: str) -> bool:
        """Return whether anybody receives this topic. The service makes no message that nobody receives."""

    def publish(self, event: Event, received_ns: int) -> None:
        """Send one event without waiting. `received_ns` is the time of its frame, for the latency."""

    def poll(self) -> None:
        """Take in what readers sent since the last call, without waiting."""

    def close(self) -> None:
        """Flush and release. Further calls do nothing."""
