"""Messages as a daemon publishes them."""

from __future__ import annotations

from touchd.event import Contact, HealthEvent, Latency, Phase, State, TouchEvent

MS = 1_000_000


def contact(id: int, phase: Phase = "move", x_mm: float = 50.0, y_mm: float = 60.0, force: float = 0.5) -> Contact:  # noqa: A002 - the field's name
    return Contact(id, phase, x_mm, y_mm, force, 0.3, 0.99, 0.0, 0.0)


def touch(*contacts: Contact, t_ns: int = 0, seq: int = 1) -> TouchEvent:
    return TouchEvent("touchd", seq, t_ns, "2025-01-01T00:00:00.000000Z", seq, list(contacts))


def health(state: State = "streaming", seq: int = 1, t_ns: int = 0) -> HealthEvent:
    wall = "2025-01-01T00:00:00.000000Z"
    return HealthEvent("touchd", seq, t_ns, wall, state, 0, 0, 0, {}, 0, Latency(), 0.0, 0.0, "model", "0")
