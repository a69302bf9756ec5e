"""What goes on the wire: touch, key and health messages, version 1 of the event bus.

Each class is the single definition of a topic: the daemon fills it, `encode` makes its JSON, and the
client reads it back with `decode`. See docs/developer.md for the meaning of the topics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import msgspec
from msgspec import Struct

Phase = Literal["down", "move", "hold", "up"]
State = Literal["starting", "streaming", "uncalibrated", "stalled", "lost", "stopping"]
VERSION = 1
SILENCE_NS = 300_000_000
"""The daemon repeats a touch every 0.1 s while a finger is down. After this silence it hangs, or is gone."""


# Without `gc`: no event can be part of a cycle, and the collector need not look at the thousands that are made.
class Contact(Struct, gc=False, omit_defaults=True):
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
    area_mm2: float | None = None
    """Area of the contact; this and what follows are absent where they cannot be told."""
    major_mm: float | None = None
    """Long axis, from end to end."""
    minor_mm: float | None = None
    """Short axis."""
    angle_deg: float | None = None
    """Of the long axis, from +x towards +y, -90..90; absent of a face too round to tell."""
    sigma_area_mm2: float | None = None
    """Standard errors of these."""
    sigma_major_mm: float | None = None
    sigma_minor_mm: float | None = None
    sigma_angle_deg: float | None = None
    kind: str | None = None
    """`finger`, `thumb` or `glove`; `palm` of one that goes up since it was a palm's. A later release may know more."""


class Message(Struct, gc=False):
    """What every message begins with."""

    device: str
    seq: int
    """Counts up by one per topic; a jump means that messages were lost."""
    t_ns: int
    """CLOCK_MONOTONIC at the chirp, ns."""
    wall: str
    """ISO 8601, UTC, at the chirp."""


class TouchEvent(Message, gc=False):
    """A frame in which a contact went down, moved or went up; and every 100 ms while one is down."""

    frame: int
    """The frame's sequence number."""
    contacts: list[Contact]
    """All contacts alive, and those that ended in this frame."""
    v: int = VERSION
    type: Literal["touch"] = "touch"
    latency_us: float = 0.0
    """Until encoded: from the frame complete on the host to the message about to be sent; last, see `encode_at`."""


class KeyEvent(Message, gc=False):
    """Keypad mode: a press or a release. Secret: never written to a log."""

    key: str
    phase: Literal["press", "release"]
    confidence: float
    v: int = VERSION
    type: Literal["key"] = "key"


class Latency(Struct, gc=False):
    """Until sent: from the frame complete on the host to its messages taken by every sink, in microseconds.

    Of the last health period; zeros when no message was sent.
    """

    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class HealthEvent(Message, gc=False):
    """Every second and on a change of state."""

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
    noise_channels: list[float] = []
    """`noise` of each channel, from the last untouched frame; empty before there was one."""
    stretch_ppm: float | msgspec.UnsetType = msgspec.UNSET
    """How much higher than at the model's training the plate's resonances are, parts per million: -45 a kelvin on
    glass; absent without a field atlas."""
    clipped: int = 0
    """Frames taken in although the ADC clipped."""
    late: int = 0
    """Frames taken in that came more than a frame's period later than the quickest ones."""
    clock_ppm: float = 0.0
    """How much faster than this computer's the device's clock runs, parts per million; 0 before it is known."""
    unheard: dict[str, int] = {}
    """Messages that were not made because nobody was subscribed, by topic."""
    model_fit: float | msgspec.UnsetType = msgspec.UNSET
    """Share of a touch's energy that the model explains, 0..1: median of the last 64 touches; absent before 8 and
    without a field atlas. Below 0.97 the plate calls for another calibration."""
    reason: str | None = None
    """Why the device is in this state, or what is wrong with its frames, for a person; last, see `encode`."""


class SpectrumEvent(Message, gc=False):
    """The feature vector of a frame, for installers; only while somebody subscribes."""

    frame: int
    features: list[float] = []
    """The model's input, ADC counts."""
    v: int = VERSION
    type: Literal["spectrum"] = "spectrum"


class PlateKey(Struct, gc=False):
    """A key of the keypad: a rectangle, mm."""

    name: str
    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float


class PlateEvent(Message, gc=False):
    """What is measured and with what, to draw it: at the start, and whenever model or keys change."""

    width_mm: float
    """0, as the height, while the plate's size is unknown: uncalibrated."""
    height_mm: float
    rate_hz: float
    """Frames a second."""
    channels: int
    samples: int
    sample_rate_hz: float
    band_hz: tuple[float, float]
    """Lowest and highest frequency of the chirp."""
    source: str
    """`usb`, `simulated`, `replay`, or what else makes the frames."""
    emitter_mm: tuple[float, float] | None = None
    """Where the discs are; None where it is unknown."""
    receivers_mm: list[tuple[float, float]] = []
    keys: list[PlateKey] = []
    """In keypad mode."""
    v: int = VERSION
    type: Literal["plate"] = "plate"


class TruthEvent(Message, gc=False):
    """Where the fingers really are: of a scene or a labelled recording; only while somebody subscribes."""

    frame: int
    contacts_mm: list[tuple[float, float]] = []
    v: int = VERSION
    type: Literal["truth"] = "truth"


Event = TouchEvent | KeyEvent | HealthEvent | SpectrumEvent | PlateEvent | TruthEvent

DECODERS: dict[str, msgspec.json.Decoder[Any]] = {
    "touch": msgspec.json.Decoder(TouchEvent),
    "key": msgspec.json.Decoder(KeyEvent),
    "health": msgspec.json.Decoder(HealthEvent),
    "spectrum": msgspec.json.Decoder(SpectrumEvent),
    "plate": msgspec.json.Decoder(PlateEvent),
    "truth": msgspec.json.Decoder(TruthEvent),
}
TOPICS = tuple(DECODERS)
_to_json = msgspec.json.Encoder().encode


def encode(event: Event) -> bytes:
    """Return the event as one UTF-8 JSON object, without the fields that are None."""
    body = _to_json(event)
    # Of a contact, msgspec leaves an absent key out; here it would leave out all that is at its default.
    return body[: -len(_NO_REASON)] + b"}" if body.endswith(_NO_REASON) else body


_NO_REASON = b',"reason":null}'


def encode_at(event: TouchEvent, received_ns: int, clock: Callable[[], int]) -> bytes:
    """Return `encode(event)` with the latency read off the clock (ns) after everything else is encoded.

    So the encoding, the larger part of the way from the tracker to the socket, counts as latency too.
    """
    body = _to_json(event)
    end = body.rindex(b":") + 1  # of the last field, a number
    return b"%b%.1f}" % (body[:end], (clock() - received_ns) * 1e-3)
