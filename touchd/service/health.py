"""Makes the health messages: state, counts of frames, noise, and the latency since the last one."""

from __future__ import annotations

import msgspec
import numpy as np
import structlog

from touchd import __version__
from touchd.config.schema import HealthSettings
from touchd.event import HealthEvent, Latency, State
from touchd.pipeline import Pipeline
from touchd.service.messages import Messages
from touchd.sources.source import LiveSource, Source, Tally

_LATENCIES = 8192
"""Kept for one health period; of more messages than that the last ones count."""
_LOGGED = ("lost", "corrupt", "clipped", "repeated", "frozen", "behind", "emitter_fault", "test_pattern")
"""Counts that are logged when they have grown."""

log = structlog.get_logger()


class Health:
    """The health of one service; a live source counts the frames that never reached the pipeline."""

    def __init__(self, source: Source, pipeline: Pipeline, messages: Messages, settings: HealthSettings) -> None:
        self._live = source if isinstance(source, LiveSource) else None
        self._pipeline, self._messages = pipeline, messages
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

    def message(self, now_ns: int, stream_ns: int, state: State, reason: str | None) -> HealthEvent:
        """Return the health message, and start the next latency window.

        `stream_ns` is the time of the last frame, 0 before the first one; `reason` is that of the state, for a person.
        """
        pipeline, unheard = self._pipeline, self._messages.unheard
        counters = pipeline.counters
        # The tally of a device tells apart what the pipeline only misses.
        tally = self._live.tally if self._live is not None else Tally(lost=counters.lost)
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
            reason=reason or pipeline.detector.fault or self._reason(),
        )

    def log_losses(self, health: HealthEvent) -> None:
        """Log each count of bad frames that has grown since the last message: at most once a period."""
        counts = {"lost": health.lost, "corrupt": health.corrupt, "clipped": health.clipped, **health.skipped}
        for name in _LOGGED:
            in_all, before = counts.get(name, 0), self._logged.get(name, 0)
            if in_all > before:
                log.warning(f"frames {name}", **{name: in_all - before, f"{name}_in_all": in_all})
                self._logged[name] = in_all

    def _reason(self) -> str | None:
        if self._pipeline.model is None:
            return "there is no model at the path in the log: touchd calibrate makes one"
        return "the screen is off" if self._pipeline.screen_off else None

    def _take_latency(self) -> Latency:
        latencies_us = self._latencies_us[: min(self._sent, _LATENCIES)]
        self._sent = 0
        if not len(latencies_us):
            return Latency()
        p50, p99, highest = np.percentile(latencies_us, (50, 99, 100)).round(1).tolist()
        return Latency(p50, p99, highest)
