"""Makes the bus's messages, health among them: one counter a topic, one wall clock for all."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from itertools import count

import msgspec
import numpy as np
import structlog
from numpy.typing import NDArray

from touchd import __version__
from touchd.config.schema import HealthSettings, Settings
from touchd.event import (
    TOPICS,
    Event,
    HealthEvent,
    KeyEvent,
    Latency,
    PlateEvent,
    PlateKey,
    SpectrumEvent,
    State,
    TouchEvent,
    TruthEvent,
)
from touchd.frame import Frame
from touchd.keypad import Layout
from touchd.pipeline import Pipeline, Result
from touchd.service.frame_feed import FeedDescription
from touchd.sources.source import Source, Tally

_LATENCIES = 8192
"""Kept for one health period; of more messages than that the last ones count."""
_STEP_NS = 500_000_000
"""UTC moves against CLOCK_MONOTONIC by more than this if somebody sets the clock, or the computer slept. The bus's
subscribers tell other clocks by a second."""
_STALE_NS = 500_000_000
"""A subscriber drops older touches, unless it asks for another `max_age_s`."""
_WHY_LATE = "this computer is too slow for its frames, or replays them with a --speed below 1"
_LOGGED = ("lost", "corrupt", "clipped", "repeated", "frozen", "behind", "emitter_fault", "test_pattern")
"""Counts that are logged when they have grown."""

log = structlog.get_logger()


def wall_offset() -> int:
    """Return UTC less CLOCK_MONOTONIC, ns."""
    return time.time_ns() - time.monotonic_ns()


class Messages:
    """Makes the touch, key and spectrum messages of one device, and stamps its health messages.

    `wants` returns whether anybody would see a message of a topic. `wall_offset` returns UTC less CLOCK_MONOTONIC, ns.
    It is asked once a second, and its steps alone count: what it jitters by does not.
    """

    def __init__(
        self, settings: Settings, wants: Callable[[str], bool], wall_offset: Callable[[], int] = wall_offset
    ) -> None:
        self.unheard = {"touch": 0, "spectrum": 0}
        """Messages that were not made because nobody wanted them, by topic."""
        self._device = settings.device.name
        self._wall_offset = wall_offset
        self._wall_offset_ns = wall_offset()
        self._asked = wants
        self._seq = {topic: count(1) for topic in TOPICS}
        self._was_touched = False
        self._wall_s = -1
        self._wall_text = ""
        self.configure(settings)

    def configure(self, settings: Settings) -> None:
        """Start or stop skipping the messages that nobody wants."""
        self.wants = self._asked if settings.skip.unheard else lambda _topic: True
        """Returns whether messages of a topic are made."""

    def make(self, result: Result, spectrum: Callable[[], list[float]]) -> Iterator[Event]:
        """Yield the messages that are due for a result; `spectrum` returns the frame's features.

        The spectrum comes last, and is taken once the others are sent: it may take as long as all else of a frame.

        A contact that goes down or comes up always has its message: subscribers to come, keys and the pre-roll rely on
        it. A movement that nobody wants is skipped and counted; the next message has the contact's position.
        """
        t_ns, frame, contacts = result.t_ns, result.sequence, result.contacts
        if contacts:
            if self.wants("touch") or any(contact.phase in ("down", "up") for contact in contacts):
                wall = self._wall(t_ns)
                yield TouchEvent(self._device, next(self._seq["touch"]), t_ns, wall, frame, contacts)
                for key in result.keys:
                    seq = next(self._seq["key"])
                    yield KeyEvent(self._device, seq, t_ns, wall, key.key, key.phase, key.confidence)
            else:
                self.unheard["touch"] += 1
        if result.touches:
            if self.wants("spectrum"):
                yield SpectrumEvent(*self.stamp("spectrum", t_ns), frame, spectrum())
            else:
                self.unheard["spectrum"] += 1

    def plate(self, d: FeedDescription, layout: Layout | None, t_ns: int) -> PlateEvent:
        """Return the message that says what is measured, by its description and the keys."""
        a = d.acquisition
        size = (d.plate.width_mm, d.plate.height_mm) if d.plate else (0.0, 0.0)
        keys = [PlateKey(k.name, k.x_mm, k.y_mm, k.width_mm, k.height_mm) for k in (layout.key if layout else ())]
        return PlateEvent(
            *self.stamp("plate", t_ns), *size, d.rate_hz, a.channels, a.samples, a.sample_rate_hz,
            (a.chirp.start_hz, a.chirp.stop_hz), d.source, d.emitter_mm, list(d.receivers_mm), keys,
        )  # fmt: skip

    def truth(self, frame: Frame, source: Source) -> TruthEvent | None:
        """Return where the fingers of a labelled frame really are; None if nobody wants it, or nothing has changed."""
        if not self._asked("truth"):
            return None
        contacts_mm = source.truth()
        if not contacts_mm and not self._was_touched:
            return None
        self._was_touched = bool(contacts_mm)
        return TruthEvent(*self.stamp("truth", frame.t_ns), frame.sequence, contacts_mm)

    def stamp(self, topic: str, t_ns: int) -> tuple[str, int, int, str]:
        """Return what each message begins with: the device, the topic's next number, `t_ns` and the wall time."""
        return self._device, next(self._seq[topic]), t_ns, self._wall(t_ns)

    def _wall(self, t_ns: int) -> str:
        utc_s, rest_ns = divmod(t_ns + self._wall_offset_ns, 1_000_000_000)
        if utc_s != self._wall_s:  # once a second: the calendar costs more than the rest of a message
            offset_ns = self._wall_offset()
            if abs(offset_ns - self._wall_offset_ns) > _STEP_NS:
                self._wall_offset_ns = offset_ns
                utc_s, rest_ns = divmod(t_ns + offset_ns, 1_000_000_000)
            self._wall_s = utc_s
            self._wall_text = datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        return f"{self._wall_text}.{rest_ns // 1000:06d}Z"


def all_but_spectra(topic: str) -> bool:
    """Want all topics but the spectrum, which costs more than the rest of a frame."""
    return topic != "spectrum"


class Health:
    """The health of one service; a live source counts the frames that never reached the pipeline."""

    def __init__(self, source: Source, pipeline: Pipeline, messages: Messages, settings: HealthSettings) -> None:
        self._source, self._pipeline, self._messages = source, pipeline, messages
        self._latencies_us = np.zeros(_LATENCIES, np.float32)
        self._sent = 0
        self._logged: dict[str, int] = {}
        self.configure(settings)

    def configure(self, settings: HealthSettings) -> None:
        """Change the period."""
        self.period_ns = round(settings.period_s * 1e9)
        """From one message to the next, ns."""

    @property
    def model_name(self) -> str:
        """Name of the model in use; empty without one."""
        return self._pipeline.model.description.name if self._pipeline.model else ""

    def add_latency(self, latency_us: float) -> None:
        """Count the latency of one frame with messages."""
        self._latencies_us[self._sent % _LATENCIES] = latency_us
        self._sent += 1

    def message(self, now_ns: int, stream_ns: int, state: State, reason: str | None, late_ns: int = 0) -> HealthEvent:
        """Return the health message, and start the next latency window.

        `stream_ns` is the time of the last frame, 0 before the first one, which came `late_ns` after it; `reason` is
        that of the state, for a person.
        """
        pipeline, unheard = self._pipeline, self._messages.unheard
        counters = pipeline.counters
        # The tally of a device tells apart what the pipeline only misses.
        tally = self._source.tally or Tally(lost=counters.lost)
        dropped = {"repeated": counters.repeated, "behind": tally.behind, **tally.withheld}
        return HealthEvent(
            *self._messages.stamp("health", stream_ns or now_ns),
            state=state,
            frames=counters.frames,
            lost=tally.lost,
            corrupt=tally.corrupt,
            skipped=counters.skipped | {why: count for why, count in dropped.items() if count},
            inferred=counters.inferred,
            latency_us=self._take_latency(),
            noise=pipeline.detector.noise_counts(),
            baseline_age_s=max(0.0, (stream_ns - pipeline.detector.followed_ns) * 1e-9),
            model=self.model_name,
            version=__version__,
            noise_channels=pipeline.noise_channels(),
            stretch_ppm=msgspec.UNSET if (stretch := pipeline.stretch) is None else round(stretch * 1e6, 1),
            clipped=tally.clipped,
            late=tally.late,
            clock_ppm=round(tally.clock_ppm, 1),
            unheard={topic: count for topic, count in unheard.items() if count},
            model_fit=msgspec.UNSET if (fit := pipeline.model_fit) is None else round(fit, 4),
            reason=reason or pipeline.detector.fault or self._reason(late_ns if state == "streaming" else 0),
        )

    def log_losses(self, health: HealthEvent) -> None:
        """Log each count of bad frames that has grown since the last message: at most once a period."""
        counts = {"lost": health.lost, "corrupt": health.corrupt, "clipped": health.clipped, **health.skipped}
        for name in _LOGGED:
            in_all, before = counts.get(name, 0), self._logged.get(name, 0)
            if in_all > before:
                log.warning(f"frames {name}", **{name: in_all - before, f"{name}_in_all": in_all})
                self._logged[name] = in_all

    def _reason(self, late_ns: int) -> str | None:
        if self._pipeline.model is None:
            return "there is no model at the path in the log: touchd calibrate makes one"
        if late_ns > _STALE_NS:
            return f"touches are {late_ns * 1e-9:.1f} s old, and many programs drop them: {_WHY_LATE}"
        return "the screen is off" if self._pipeline.screen_off else None

    def _take_latency(self) -> Latency:
        latencies_us = self._latencies_us[: min(self._sent, _LATENCIES)]
        self._sent = 0
        return latency_of(latencies_us) if len(latencies_us) else Latency()


def latency_of(latencies_us: list[float] | NDArray[np.float32]) -> Latency:
    """Return the percentiles of latencies in microseconds, of which there is at least one."""
    return Latency(*np.percentile(latencies_us, (50, 99, 100)).round(1).tolist())
