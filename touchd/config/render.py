"""Write the configuration as text: a commented TOML file, and what each key takes."""

from __future__ import annotations

import json
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from touchd.config.schema import Settings

_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", Path: "a path"}


def section(table: str) -> type[BaseModel]:
    """Return the model of a table."""
    model: type[BaseModel] = type(Settings.model_fields[table].default)
    return model


def summary(table: str) -> str:
    """Return what a table is about, in a line."""
    return (section(table).__doc__ or "").split("\n", 1)[0]


def fields() -> Iterator[tuple[str, str, FieldInfo]]:
    """Yield the table, the key and the definition of every setting, in order."""
    for table in Settings.model_fields:
        for key, field in section(table).model_fields.items():
            yield table, key, field


def variable(table: str, key: str) -> str:
    """Return the environment variable that sets a key."""
    return f"TOUCHD_{table}__{key}".upper()


def is_secret(key: str) -> bool:
    """Return whether no message may repeat the value of a key."""
    return any(word in key.lower() for word in ("secret", "password", "token"))


def expected(field: FieldInfo) -> str:
    """Return what a key takes: its type and its range, in words."""
    kind = _kind(field.annotation)
    limits: dict[type, Any] = {type(limit): limit for limit in field.metadata}
    low, above = limits.get(annotated_types.Ge), limits.get(annotated_types.Gt)
    high, below = limits.get(annotated_types.Le), limits.get(annotated_types.Lt)
    length, multiple = limits.get(annotated_types.MinLen), limits.get(annotated_types.MultipleOf)
    words = []
    if low and high:
        words.append(f"{low.ge:g} to {high.le:g}")
    elif low:
        words.append(f"at least {low.ge:g}")
    elif high:
        words.append(f"at most {high.le:g}")
    if above:
        words.append(f"above {above.gt:g}")
    if below:
        words.append(f"below {below.lt:g}")
    if multiple:
        words.append(f"a multiple of {multiple.multiple_of:g}")
    if length:
        words.append("not empty")
    return f"{kind}, {' and '.join(words)}" if words else kind


def expected_item(field: FieldInfo) -> str:
    """Return what each item of a list must be."""
    item = get_args(field.annotation)[0]
    if get_origin(item) is tuple:
        return "a place, [x, y]"
    return "an address, tcp:// or ipc://" if get_origin(item) is Annotated else _kind(item)


def _kind(annotation: Any) -> str:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if origin in (Union, types.UnionType):
        return " or ".join("empty" if part is type(None) else _kind(part) for part in arguments)
    if origin is tuple:
        item = arguments[0]
        if get_origin(item) is Literal:
            return f"a list of {', '.join(get_args(item))}"
        if get_origin(item) is tuple:
            return "a list of places, [x, y]"
        numbers = {int: "a list of whole numbers", float: "a list of numbers"}
        return numbers.get(item, "a list of addresses, tcp:// or ipc://")
    return _NAMES.get(annotation, str(annotation))


def toml_value(value: Any, key: str = "") -> str:
    """Return a value in TOML; an unset path is an empty text."""
    if value is None:
        return '""'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return f"[{', '.join(toml_value(item) for item in value)}]"
    if isinstance(value, int) and key in ("vendor_id", "product_id"):
        return f"0x{value:04x}"
    if isinstance(value, int | float):
        return repr(value)
    # JSON's escapes are TOML's, but JSON leaves one control character as it is.
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


_FILE_HEAD = f"""\
# The configuration of touchd: every key, and the value in effect. A key that is left out takes its default.
# Each can also be set by the environment variable TOUCHD_TABLE__KEY, for example {variable("bus", "bind")}.
"""


def render(settings: Settings) -> str:
    """Return the settings as a TOML file that loads again: every key with its value, default, range and meaning."""
    text = _FILE_HEAD
    for table in Settings.model_fields:
        text += f"\n# {summary(table)}\n[{table}]\n"
        for key, field in section(table).model_fields.items():
            wanted = expected(field)
            value = getattr(getattr(settings, table), key)
            text += f"# {field.description}\n"
            text += f"# {wanted[:1].upper()}{wanted[1:]}. Default: {toml_value(field.default, key)}\n"
            text += f"{key} = {toml_value(value, key)}\n"
    return text
