"""Values for every key, drawn from the schema: its ends, what lies just beyond them, and what nobody means."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from hypothesis import strategies as st
from pydantic.fields import FieldInfo

from touchd.config.load import load
from touchd.config.render import fields
from touchd.config.schema import Settings
from touchd.errors import ConfigError
from touchd.frame import MAX_SAMPLES

_NUMBERS = (
    -1, 0, 1, 2, 10**9, 10**20, 10**400, 5e-324, 1e-300, 1e-17, 1e-9, 0.1, 0.5, 1 - 2**-53, 1e5, 1e9, 1e17, 1e300,
    1.7e308,
)  # fmt: skip
_TEXTS = ("", "a", "127.0.0.1:1", "\0", "a\0b", "é ,'\"\n", "x" * 5000)
_LISTS: tuple[list[Any], ...] = (
    [],
    [1, 2, 3],
    [1e3, 2e3],
    [0, 0, 200, 100],
    ["palm", "water"],
    [[12, 12], [-1e5, 1e3]],
)
_ENDPOINTS = ("ipc://a\0b", "ipc:///" + "x" * 500, "tcp://:", "tcp://127.0.0.1:99999", "tcp://*:*")


def ends(field: FieldInfo) -> list[float]:
    """Return the lowest and the highest number that a key takes, as far as it has limits."""
    found = []
    for limit in field.metadata:
        for name, inward in (("ge", 0.0), ("gt", math.inf), ("le", 0.0), ("lt", -math.inf)):
            end = getattr(limit, name, None)
            if end is not None:
                found.append(math.nextafter(end, inward) if inward else end)
    return found


def candidates(field: FieldInfo) -> list[Any]:
    """Return values that somebody may write for a key."""
    kind = field.annotation
    if kind is bool:
        return [True, False]
    if kind in (int, float):
        beyond = [math.nextafter(float(end), to) for end in ends(field) for to in (math.inf, -math.inf)]
        return [*ends(field), *beyond, *_NUMBERS]
    if get_origin(kind) is Literal:
        return list(get_args(kind))
    if get_origin(kind) is tuple:
        return [*_LISTS, *([address] for address in _ENDPOINTS)]
    return [*_TEXTS, *([Path("/nowhere/at all"), Path("x" * 5000)] if kind is not str else [])]


def accepted(table: str, key: str, field: FieldInfo) -> Iterator[Settings]:
    """Yield the settings that `load` makes of a key's candidates, less those that it refuses."""
    for value in candidates(field):
        try:
            yield load(None, {table: {key: value}})
        except ConfigError:
            continue


@st.composite
def any_settings(draw: st.DrawFn) -> Settings:
    """Draw settings of which every number is an end of its range or lies between them."""
    tables: dict[str, dict[str, Any]] = {}
    for table, key, field in fields():
        keys, value = tables.setdefault(table, {}), field.default
        if field.annotation is bool:
            value = draw(st.booleans())
        elif field.annotation in (int, float):
            low, high = ends(field)
            between = st.integers if field.annotation is int else st.floats
            value = draw(st.sampled_from([low, high, field.default]) | between(low, high))  # type: ignore[arg-type]  # its bounds are numbers here
            for step in (step for limit in field.metadata if (step := getattr(limit, "multiple_of", None))):
                value -= value % step
        keys[key] = value
    if tables["ni"]["amplitude_v"] > tables["ni"]["output_limit_v"]:
        del tables["ni"]["amplitude_v"], tables["ni"]["output_limit_v"]
    if tables["audio"]["loopback"] in tables["audio"]["channels"]:
        del tables["audio"]["loopback"]
    rate_hz = tables["audio"]["sample_rate_hz"]
    low_hz = draw(st.floats(20, 0.4 * rate_hz))
    tables["audio"]["band_hz"] = low_hz, draw(st.floats(1.01 * low_hz, 0.49 * rate_hz))
    tables["audio"]["chirp_s"] = draw(st.floats(max(1e-4, 1.001 / low_hz), min(0.1, 0.9 * MAX_SAMPLES / rate_hz)))
    tables["model"]["feet_mm"] = draw(st.lists(st.tuples(st.floats(-1e5, 1e5), st.floats(-10, 300)), max_size=6))
    return Settings.model_validate(tables)
