"""What goes on the wire: touch, key and health messages, version 1 of the event bus.

Each class is the single definition of a topic: the daemon fills it, `encode` makes its JSON, and the
client reads it back with `decode`. See docs/subscribing.md for the meaning of the topics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from pydantic import TypeAdapter

Phase = Literal["down", "move", "hold", "up"]
State = Literal["starting", "streaming", "stalled", "lost", "stopping"]
VERSION = 1


@dataclass(slots=True)
class Contact:
    """One finger, as the tracker sees it. Millimetres from the plate's top-left corner, x right, y down."""

    id: int
    """Never reused within a run."""
    phase: Phase
    x_mm: float
    y_mm: float
    force: float
    """0..1, relative: how strongly the contact changes the plate's response."""
    sigma_mm: float
    """Predicted standard error of the position, per axis."""
    confidence: float
    """0..1: how much the frame looks like a finger."""
    vx_mm_s: float
    vy_mm_s: float
    key: str | None = None
    """The key under the contact; only in keypad mode."""


@dataclass(slots=True)
class TouchEvent:
    """A frame in which a contact went down, moved or went up; and every 100 ms while one is down."""

    device: str
    seq: int
    """Counts up by one per topic; a jump means that messages were lost."""
    t_ns: int
    """CLOCK_MONOTONIC at the chirp, ns."""
    wall: str
    """ISO 8601, UTC, at the chirp."""
    frame: int
    """The frame's sequence number."""
    contacts: list[Contact]
    """All contacts alive, and those that ended in this frame."""
    v: int = VERSION
    type: Literal["touch"] = "touch"
    latency_us: float = 0.0
    """From the frame complete on the host to the message handed to the socket; last, see `encode_at`."""


@dataclass(slots=True)
class KeyEvent:
    """Keypad mode: a press or a release. Secret: never written to a log."""

    device: str
    seq: int
    t_ns: int
    wall: str
    key: str
    phase: Literal["press", "release"]
    confidence: float
    v: int = VERSION
    type: Literal["key"] = "key"


@dataclass(slots=True)
class Latency:
    """Latency over the last health period, in microseconds; zeros when no message was sent."""

    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


@dataclass(slots=True)
class HealthEvent:
    """Every second and on a change of state."""

    device: str
    seq: int
    t_ns: int
    wall: str
    state: State
    frames: int
    """Frames taken in since the start."""
    lost: int
    """Frames the device counted but this host never saw, less the corrupt ones where the device can tell them apart."""
    corrupt: int
    """Frames that failed a check and were dropped."""
    skipped: dict[str, int]
    """Frames that needed no inference, by reason."""
    inferred: int
    """Frames that went through the model."""
    latency_us: Latency
    noise: float
    """RMS of an untouched frame against the baseline, ADC counts."""
    baseline_age_s: float
    """Time since the baseline last took in a frame."""
    model: str
    version: str
    v: int = VERSION
    type: Literal["health"] = "health"
    clipped: int = 0
    """Frames taken in although the ADC clipped."""
    late: int = 0
    """Frames taken in that came more than a frame's period later than the quickest ones."""
    reason: str | None = None
    """Why the device is in this state, for a person."""


@dataclass(slots=True)
class SpectrumEvent:
    """The feature vector of a frame, for installers; only while somebody subscribes."""

    device: str
    seq: int
    t_ns: int
    wall: str
    frame: int
    features: list[float] = field(default_factory=list)
    """The model's input, ADC counts."""
    v: int = VERSION
    type: Literal["spectrum"] = "spectrum"


Event = TouchEvent | KeyEvent | HealthEvent | SpectrumEvent
TOPICS = ("touch", "key", "health", "spectrum")

_ADAPTERS: dict[str, TypeAdapter[Event]] = {
    "touch": TypeAdapter(TouchEvent),
    "key": TypeAdapter(KeyEvent),
    "health": TypeAdapter(HealthEvent),
    "spectrum": TypeAdapter(SpectrumEvent),
}


def encode(event: Event) -> bytes:
    """Return the event as one UTF-8 JSON object, without the fields that are None."""
    return _ADAPTERS[event.type].dump_json(event, exclude_none=True)


_LATENCY = b'"latency_us":'


def encode_at(event: TouchEvent, received_ns: int, clock: Callable[[], int]) -> bytes:
    """Return `encode(event)` with the latency read off the clock (ns) after everything else is encoded.

    So the encoding, the larger part of the way from the tracker to the socket, counts as latency too.
    """
    body = encode(event)
    end = body.rindex(_LATENCY) + len(_LATENCY)  # the last field; inside a string its quotes would be escaped
    return b"%b%.1f}" % (body[:end], (clock() - received_ns) * 1e-3)


def decode(topic: str, payload: bytes) -> Event:
    """Return the event of a message.

    Unknown keys are ignored, as the format asks of readers.

    Raises
    ------
    KeyError
        If the topic is not one of `TOPICS`.
    pydantic.ValidationError
        If the payload is no such event.
    """
    return _ADAPTERS[topic].validate_json(payload)
