"""A recording through the whole pipeline in this process, for tests, scores and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from touchd.config.schema import Settings
from touchd.event import Event, TouchEvent
from touchd.outcome import Counters
from touchd.service.daemon import make_messages, make_pipeline
from touchd.sources.replay import ReplaySource
from touchd.sources.source import EndOfStream, Source


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a replay gave."""

    events: list[Event]
    counters: Counters
    notices: list[tuple[str, dict[str, float]]]
    """Each change of the baseline that was no mere drift: the reason, and its figures."""

    @property
    def touches(self) -> list[TouchEvent]:
        """The touch messages."""
        return [event for event in self.events if isinstance(event, TouchEvent)]


def replay(path: Path, settings: Settings) -> Outcome:
    """Return the events of a recording, as fast as they can be had."""
    return run_through(ReplaySource(path, speed=float("inf")), settings)


def run_through(source: Source, settings: Settings) -> Outcome:
    """Return the events of a source that ends."""
    notices: list[tuple[str, dict[str, float]]] = []
    pipeline, _ = make_pipeline(
        source, settings, make_messages(settings), notify=lambda reason, fields: notices.append((reason, fields))
    )
    events: list[Event] = []
    last_ns = 0
    try:
        while True:
            frame = source.read(1.0)
            if frame is not None:
                last_ns = frame.t_ns
                events += pipeline.process(frame)
    except EndOfStream:
        events += pipeline.lose(last_ns)
    finally:
        source.close()
    return Outcome(events, pipeline.counters, notices)
