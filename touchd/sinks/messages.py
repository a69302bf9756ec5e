"""Makes the bus's messages: one counter a topic, one wall clock for all."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import count

from touchd.event import TOPICS, Contact, Event, HealthEvent, KeyEvent, Latency, SpectrumEvent, State, TouchEvent


class Messages:
    """The events of one device.

    Parameters
    ----------
    device : str
        The name published in each message.
    wall_offset_ns : int
        UTC less CLOCK_MONOTONIC, ns, taken once at the start: the messages' wall time never steps back.
    """

    def __init__(self, device: str, wall_offset_ns: int) -> None:
        self._device = device
        self._wall_offset_ns = wall_offset_ns
        self._seq = {topic: count(1) for topic in TOPICS}
        self._pressed: dict[int, str] = {}
        self._wall_s = -1
        self._wall_text = ""

    def touch(self, t_ns: int, frame: int, contacts: list[Contact]) -> list[Event]:
        """Return the touch message, and the presses and releases of keys that it means."""
        wall = self._wall(t_ns)
        events: list[Event] = [TouchEvent(self._device, next(self._seq["touch"]), t_ns, wall, frame, contacts)]
        events += self._keys(t_ns, wall, contacts)
        return events

    def spectrum(self, t_ns: int, frame: int, features: list[float]) -> SpectrumEvent:
        """Return the message with a frame's features."""
        return SpectrumEvent(self._device, next(self._seq["spectrum"]), t_ns, self._wall(t_ns), frame, features)

    def health(
        self,
        t_ns: int,
        *,
        state: State,
        frames: int,
        lost: int,
        corrupt: int,
        skipped: dict[str, int],
        inferred: int,
        latency_us: Latency,
        noise: float,
        baseline_age_s: float,
        model: str,
        version: str,
        clipped: int = 0,
        late: int = 0,
        unheard: dict[str, int] | None = None,
        reason: str | None = None,
    ) -> HealthEvent:
        """Return the message on the daemon's own state."""
        return HealthEvent(
            self._device,
            next(self._seq["health"]),
            t_ns,
            self._wall(t_ns),
            state,
            frames,
            lost,
            corrupt,
            dict(skipped),
            inferred,
            latency_us,
            noise,
            baseline_age_s,
            model,
            version,
            clipped=clipped,
            late=late,
            unheard=dict(unheard or {}),
            reason=reason,
        )

    def _keys(self, t_ns: int, wall: str, contacts: Sequence[Contact]) -> list[Event]:
        """A key is pressed where a finger goes down, and released when that finger comes up, wherever it slid."""
        events: list[Event] = []
        for contact in contacts:
            if contact.phase == "down" and contact.key is not None:
                self._pressed[contact.id] = contact.key
                events.append(
                    KeyEvent(self._device, next(self._seq["key"]), t_ns, wall, contact.key, "press", contact.confidence)
                )
            elif contact.phase == "up" and (key := self._pressed.pop(contact.id, None)) is not None:
                events.append(
                    KeyEvent(self._device, next(self._seq["key"]), t_ns, wall, key, "release", contact.confidence)
                )
        return events

    def _wall(self, t_ns: int) -> str:
        utc_s, rest_ns = divmod(t_ns + self._wall_offset_ns, 1_000_000_000)
        if utc_s != self._wall_s:  # the calendar is asked once a second: it costs more than all the rest
            self._wall_s = utc_s
            self._wall_text = datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        return f"{self._wall_text}.{rest_ns // 1000:06d}Z"


def is_change(contacts: Sequence[Contact]) -> bool:
    """Return whether a contact went down or came up: what nobody may miss, unlike where it moved meanwhile."""
    for contact in contacts:  # noqa: SIM110 - asked in each frame: `any` takes three times as long
        if contact.phase == "down" or contact.phase == "up":
            return True
    return False
