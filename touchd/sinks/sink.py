"""Where events go. A sink never blocks and never raises for the sake of a reader."""

from __future__ import annotations

from typing import Protocol

from touchd.event import Event


class Sink(Protocol):
    """What the service asks of a sink."""

    def wants(self, topic: str) -> bool:
        """Return whether anybody would see a message of this topic, so that none is built in vain."""
        ...

    def publish(self, event: Event, received_ns: int) -> None:
        """Hand one event over, without waiting. `received_ns` is its frame's, for the latency."""
        ...

    def poll(self) -> None:
        """Do what has come up since the last call, without waiting."""
        ...

    def close(self) -> None:
        """Flush and release; further calls do nothing."""
        ...
