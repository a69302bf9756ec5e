"""A recording through the whole pipeline in this process, for tests, scores and pictures."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from touchd.config.schema import Settings
from touchd.event import Event, TouchEvent
from touchd.localization.model import Model
from touchd.outcome import Counters
from touchd.service.daemon import make_pipeline
from touchd.service.messages import Messages, all_but_spectra
from touchd.service.runner import frames_of
from touchd.sources.replay import ReplaySource
from touchd.sources.source import Source


@dataclass(frozen=True, slots=True)
class Replayed:
    """What a replay gave."""

    events: list[Event]
    counters: Counters
    unheard: dict[str, int]
    """Messages that were not made, by topic."""
    notices: list[tuple[str, dict[str, float]]]
    """Each time the baseline was relearned: the reason, and fields for the log."""

    @property
    def touches(self) -> list[TouchEvent]:
        """The touch messages."""
        return [event for event in self.events if isinstance(event, TouchEvent)]


def replay(path: Path, settings: Settings, model: Model | None = None) -> Replayed:
    """Run a recording through the pipeline as fast as possible; see `run_through`."""
    return run_through(ReplaySource(path, speed=float("inf")), settings, model)


def run_through(source: Source, settings: Settings, model: Model | None = None) -> Replayed:
    """Run a source through the pipeline until it ends, close it, and return its events, all but the spectra.

    Without `model`, the one that the settings name is loaded.
    """
    notices: list[tuple[str, dict[str, float]]] = []
    pipeline = make_pipeline(source, settings, model, lambda reason, fields: notices.append((reason, fields)))
    messages = Messages(settings, all_but_spectra)
    events: list[Event] = []
    last_ns = 0
    with closing(source):
        for frame in frames_of(source):
            if frame is not None:
                last_ns = frame.t_ns
                events += messages.make(pipeline.process(frame), pipeline.spectrum)
    events += messages.make(pipeline.release(last_ns), pipeline.spectrum)
    return Replayed(events, pipeline.counters, messages.unheard, notices)
