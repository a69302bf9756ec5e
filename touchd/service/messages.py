"""Makes the bus's messages: one counter a topic, one wall clock for all."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from itertools import count

from touchd.config.schema import Settings
from touchd.event import TOPICS, Event, KeyEvent, PlateEvent, PlateKey, SpectrumEvent, TouchEvent, TruthEvent
from touchd.frame import Frame
from touchd.keypad import Layout
from touchd.pipeline import Result
from touchd.service.frame_feed import FeedDescription
from touchd.sources.source import Labelled


class Messages:
    """Makes the touch, key and spectrum messages of one device, and stamps its health messages.

    Parameters
    ----------
    settings : Settings
        The device's name, and whether messages that nobody wants are skipped.
    wants : callable
        Returns whether anybody would see a message of a topic.
    wall_offset_ns : int, optional
        UTC less CLOCK_MONOTONIC, ns. Read once, so that the messages' wall time never steps back.
    """

    def __init__(self, settings: Settings, wants: Callable[[str], bool], wall_offset_ns: int | None = None) -> None:
        self.unheard = {"touch": 0, "spectrum": 0}
        """Messages that were not made because nobody wanted them, by topic."""
        self._device = settings.device.name
        self._wall_offset_ns = time.time_ns() - time.monotonic_ns() if wall_offset_ns is None else wall_offset_ns
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

    def truth(self, frame: Frame, source: Labelled) -> TruthEvent | None:
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
            self._wall_s = utc_s
            self._wall_text = datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        return f"{self._wall_text}.{rest_ns // 1000:06d}Z"


def all_but_spectra(topic: str) -> bool:
    """Want all topics but the spectrum, which costs more than the rest of a frame."""
    return topic != "spectrum"
