"""Decode what came over the bus, and explain what is no message of touchd's."""

from __future__ import annotations

import re

import msgspec

from touchd.errors import BusError
from touchd.event import DECODERS, TOPICS, VERSION, Event

_LONGEST_BYTES = 1 << 20
"""A spectrum has some ten thousand."""
_KNOWN = {topic.encode(): (topic, DECODERS[topic].decode) for topic in TOPICS}


def decode_message(parts: list[bytes], address: str) -> Event | None:
    """Return the event of a message, or None if its topic is newer than this program.

    Raises BusError if the message is not one of the bus, and quotes nothing of it: a key press is secret.
    """
    known = _KNOWN.get(parts[0])
    if known is None:
        return None
    topic, decode = known
    if len(parts) != 2:
        raise BusError(
            f"a {topic} message of {len(parts)} parts instead of 2", address, "is it a touchd that publishes?"
        )
    if len(parts[1]) > _LONGEST_BYTES:
        raise BusError(f"a {topic} message of {len(parts[1])} bytes", address, "is it a touchd that publishes?")
    try:
        event: Event = decode(parts[1])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        problem = _problem(error)
        version = _version(parts[1])
    else:
        if event.v == VERSION:
            return event
        problem, version = "", event.v
    if isinstance(version, int) and version != VERSION:
        raise BusError(
            f"a {topic} message of version {version}, and this program knows {VERSION}", address, "upgrade touchd here"
        )
    raise BusError(f"not a {topic} message ({problem})", address, "is it a touchd that publishes?")


def _problem(error: Exception) -> str:
    """Return which field is wrong; neither its value nor the error itself, which quotes it: a key press is secret."""
    if not isinstance(error, msgspec.ValidationError):
        return "payload: no JSON"
    said, _, where = str(error).rpartition(" - at `")
    expected = re.fullmatch(r"Expected `[a-z |]+`, got `[a-z]+`|Object missing required field `[a-z_]+`", said or where)
    return f"{where.rstrip('`').removeprefix('$.') or 'payload'}: {expected[0] if expected else 'not as agreed'}"


class _Versioned(msgspec.Struct):
    v: object = VERSION


def _version(payload: bytes) -> object:
    """Return the version that an undecodable payload claims, or the known one if it claims none."""
    try:
        return msgspec.json.decode(payload, type=_Versioned).v
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return VERSION
