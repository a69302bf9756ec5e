"""What is on the wire is what the daemon meant."""

from __future__ import annotations

import json

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.event import (
    DECODERS,
    Contact,
    Event,
    HealthEvent,
    KeyEvent,
    Latency,
    SpectrumEvent,
    TouchEvent,
    encode,
    encode_at,
)

NUMBER = st.floats(allow_nan=False, allow_infinity=False)
COUNT = st.integers(0, 2**63 - 1)
HEAD = {"device": st.text(), "seq": COUNT, "t_ns": COUNT, "wall": st.text()}
# Names that look like the field which `encode_at` fills in.
AWKWARD = st.text() | st.sampled_from(['"latency_us":0.0}', '","latency_us":1.0}', "\\", "☃"])
CONTACT = st.builds(
    Contact,
    id=COUNT,
    phase=st.sampled_from(["down", "move", "hold", "up"]),
    x_mm=NUMBER,
    y_mm=NUMBER,
    force=NUMBER,
    sigma_mm=NUMBER,
    confidence=NUMBER,
    vx_mm_s=NUMBER,
    vy_mm_s=NUMBER,
    key=st.none() | AWKWARD,
    area_mm2=st.none() | NUMBER,
    angle_deg=st.none() | NUMBER,
    sigma_major_mm=st.none() | NUMBER,
)
TOUCH = st.builds(TouchEvent, **HEAD, frame=COUNT, contacts=st.lists(CONTACT, max_size=3), latency_us=NUMBER)
KEY = st.builds(KeyEvent, **HEAD, key=AWKWARD, phase=st.sampled_from(["press", "release"]), confidence=NUMBER)
HEALTH = st.builds(
    HealthEvent,
    **HEAD,
    state=st.sampled_from(["starting", "streaming", "stalled", "lost", "stopping"]),
    frames=COUNT,
    lost=COUNT,
    corrupt=COUNT,
    skipped=st.dictionaries(st.text(), COUNT, max_size=3),
    inferred=COUNT,
    latency_us=st.builds(Latency, NUMBER, NUMBER, NUMBER),
    noise=NUMBER,
    baseline_age_s=NUMBER,
    model=st.text(),
    version=st.text(),
)
SPECTRUM = st.builds(SpectrumEvent, **HEAD, frame=COUNT, features=st.lists(NUMBER, max_size=5))


@given(TOUCH | KEY | HEALTH | SPECTRUM)
def test_every_event_survives_the_wire_unchanged(event: Event) -> None:
    assert DECODERS[event.type].decode(encode(event)) == event


@given(TOUCH, st.integers(0, 2**62), st.integers(0, 10**12))
def test_encoding_late_changes_the_latency_and_nothing_else(event: TouchEvent, received_ns: int, took_ns: int) -> None:
    payload = encode_at(event, received_ns, lambda: received_ns + took_ns)
    stamped = DECODERS["touch"].decode(payload)
    assert isinstance(stamped, TouchEvent)
    assert stamped.latency_us == pytest.approx(took_ns / 1000, abs=0.051)
    # Byte for byte, but for the number itself.
    cut = payload.rindex(b":")
    assert payload[:cut] == encode(event)[: encode(event).rindex(b":")]
    assert msgspec.structs.replace(stamped, latency_us=event.latency_us) == event


def test_the_latency_is_read_after_everything_else_is_encoded(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = []

    to_json = msgspec.json.Encoder().encode

    def encoding(event: Event) -> bytes:
        steps.append("encode")
        return to_json(event)

    def clock() -> int:
        steps.append("clock")
        return 0

    monkeypatch.setattr("touchd.event._to_json", encoding)
    encode_at(TouchEvent("plate", 1, 0, "", 1, []), 0, clock)
    assert steps == ["encode", "clock"]


@given(TOUCH | KEY | HEALTH | SPECTRUM)
def test_a_message_is_one_line_of_json_that_says_its_version_and_type(event: Event) -> None:
    payload = encode(event)
    assert b"\n" not in payload
    content = json.loads(payload)
    assert (content["v"], content["type"]) == (1, event.type)
    assert None not in content.values()


def test_keys_of_a_later_release_are_ignored() -> None:
    event = TouchEvent("plate", 1, 2, "now", 3, [Contact(1, "down", 1.0, 2.0, 0.5, 1.0, 0.9, 0.0, 0.0)])
    content = json.loads(encode(event))
    content["mood"] = "sunny"
    content["contacts"][0]["finger"] = "thumb"
    assert DECODERS["touch"].decode(json.dumps(content).encode()) == event


def test_a_contact_outside_keypad_mode_has_no_key() -> None:
    event = TouchEvent("plate", 1, 2, "now", 3, [Contact(1, "down", 1.0, 2.0, 0.5, 1.0, 0.9, 0.0, 0.0)])
    assert b'"key"' not in encode(event)


def test_size() -> None:
    """A contact whose size cannot be told is, byte for byte, one of before contacts had a size."""
    contact = Contact(1, "down", 1.0, 2.0, 0.5, 1.0, 0.9, 0.0, 0.0)
    before = b'{"id":1,"phase":"down","x_mm":1.0,"y_mm":2.0,"force":0.5,"sigma_mm":1.0,"confidence":0.9,'
    before += b'"vx_mm_s":0.0,"vy_mm_s":0.0}'
    assert msgspec.json.encode(contact) == before
    assert msgspec.json.decode(before, type=Contact) == contact
    sized = msgspec.structs.replace(contact, area_mm2=80.0, sigma_area_mm2=3.0)
    assert msgspec.json.encode(sized) == before[:-1] + b',"area_mm2":80.0,"sigma_area_mm2":3.0}'


def test_model_fit() -> None:
    """Health has `model_fit` once it is known; before, the key is absent."""
    known = HealthEvent("d", 1, 2, "w", "streaming", 0, 0, 0, {}, 0, Latency(), 0.0, 0.0, "m", "1", model_fit=0.997)
    assert json.loads(encode(known))["model_fit"] == 0.997
    assert b"model_fit" not in encode(msgspec.structs.replace(known, model_fit=msgspec.UNSET))
    assert DECODERS["health"].decode(encode(known)) == known
