"""Where events go, and the sink that writes them as lines of JSON, for `--print`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol, TextIO

import structlog

from touchd.event import Event, TouchEvent, encode, encode_at

log = structlog.get_logger()


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


class JsonlSink:
    """Writes one line of JSON per event, and flushes it.

    It writes touches, keys and health. Key presses are secret: the stream must not end in a log. Unlike the bus it
    waits for a terminal or a pipe that is not read: it is for looking, not for production. When the reader is gone or
    the disk is full, the sink stops writing and the daemon runs on. The stream stays open.
    """

    def __init__(self, stream: TextIO, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._stream = stream
        self._topics = frozenset({"touch", "key", "health"})
        self._clock = clock

    def wants(self, topic: str) -> bool:
        """Return whether this topic is written."""
        return topic in self._topics

    def publish(self, event: Event, received_ns: int) -> None:
        """Write one event if its topic is wanted."""
        if event.type not in self._topics:
            return
        body = encode_at(event, received_ns, self._clock) if isinstance(event, TouchEvent) else encode(event)
        try:
            self._stream.write(body.decode() + "\n")
            self._stream.flush()
        except (BrokenPipeError, ValueError):  # ValueError: the stream was closed
            self._topics = frozenset()
        except OSError as error:
            self._topics = frozenset()
            log.warning("events are printed no more", error=error.strerror)

    def poll(self) -> None:
        """Do nothing: a stream has no subscribers."""

    def close(self) -> None:
        """Stop writing. The stream belongs to the caller."""
        self._topics = frozenset()
