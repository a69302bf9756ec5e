"""Events as lines of JSON, for `--print`: people, pipes and tests read them."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import TextIO

import structlog

from touchd.event import Event, TouchEvent, encode, encode_at

log = structlog.get_logger()


class JsonlSink:
    """One line of JSON per event, flushed at once.

    A terminal or a pipe that is not read makes the writer wait, unlike the bus: this is for looking, not for
    production. When the reader has gone, or the disk is full, the sink falls silent; the bus goes on.

    Parameters
    ----------
    stream : TextIO
        Where the lines go; it stays open.
    topics : Collection[str]
        What is written. Key presses are secret: leave `key` out where the stream ends in a log.
    clock : Callable
        CLOCK_MONOTONIC in ns, for the latency.
    """

    def __init__(
        self,
        stream: TextIO,
        topics: Collection[str] = ("touch", "key", "health"),
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._stream = stream
        self._topics = frozenset(topics)
        self._clock = clock

    def wants(self, topic: str) -> bool:
        """Return whether lines of this topic are written."""
        return topic in self._topics

    def publish(self, event: Event, received_ns: int) -> None:
        """Write one event, if its topic is wanted."""
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
        """Do nothing: lines have no subscribers."""

    def close(self) -> None:
        """Write no more; the stream belongs to the caller."""
        self._topics = frozenset()
