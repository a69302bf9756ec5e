"""Explain what is wrong in a configuration: where it stands, what the value must be, and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from pydantic import ValidationError

from touchd.config.render import expected, expected_item, fields, is_secret, section, toml_value, variable
from touchd.config.schema import Settings
from touchd.errors import ConfigError

REMOVE = "remove it; `touchd config --default` prints every key"
Loc = tuple[int | str, ...]
"""Pydantic's location of a value: table, key, index in a list."""


class Layer(NamedTuple):
    """The settings of one place: the command line, the environment or the file."""

    where: str
    content: dict[str, Any]
    by_variable: bool = False
    """A message names the variable `TOUCHD_BUS__BIND`, not the key `bus.bind`."""

    def holds(self, loc: Loc) -> bool:
        """Return whether this layer sets the table or key at `loc`."""
        layer: Any = self.content
        for part in loc[:2]:
            if not isinstance(layer, Mapping) or part not in layer:
                return False
            layer = layer[part]
        return True

    def place(self, loc: Loc) -> str:
        """Return where the value at `loc` stands, for a message."""
        key, items = ".".join(map(str, loc[:2])), "".join(f"[{part}]" for part in loc[2:])
        name = variable(*map(str, loc[:2])) if self.by_variable and len(loc) > 1 else key + items
        return f"{self.where}: {name}"


def explain(error: ValidationError, layers: Sequence[Layer]) -> list[ConfigError]:
    """Explain each of pydantic's findings once, in plain words. `layers` are in order of precedence."""
    found = error.errors(include_url=False, include_context=False)
    # A bad item makes the whole list bad: the item is enough.
    return [
        _explain(e["type"], e["loc"], e["input"], e["msg"], layers)
        for e in found
        if not any(len(other["loc"]) > len(e["loc"]) and other["loc"][: len(e["loc"])] == e["loc"] for other in found)
    ]


def _explain(kind: str, loc: Loc, value: Any, message: str, layers: Sequence[Layer]) -> ConfigError:
    key = ".".join(map(str, loc[:2]))
    where = next((layer.place(loc) for layer in layers if layer.holds(loc)), key)
    if kind == "extra_forbidden":
        return ConfigError("unknown key" if len(loc) > 1 else "unknown table or key", where, _suggest(loc) or REMOVE)
    if len(loc) < 2:
        return ConfigError(f"is {_shown(key, value)}, must be a table", where, f"write [{key}], and its keys below it")
    field = section(str(loc[0])).model_fields[str(loc[1])]
    fix = f"correct it, or leave it out for the default, {toml_value(field.default)}"
    if kind == "value_error":
        return ConfigError(message.removeprefix("Value error, "), where, fix)
    wanted = expected(field) if len(loc) == 2 else expected_item(field)
    return ConfigError(f"is {_shown(key, value)}, must be {wanted}", where, fix)


def _shown(key: str, value: Any) -> str:
    if is_secret(key):
        return "something else (not shown)"
    try:
        text = "empty" if value in ("", [], ()) else repr(value)
    except ValueError:  # a whole number of thousands of digits
        text = "far too large"
    return text if len(text) <= 60 else f"{text[:57]}..."


def _suggest(loc: Loc) -> str:
    """Suggest the key of this name in any table, or one of a similar name in this table."""
    name = str(loc[-1])
    same = [f"{table}.{key}" for table, key, _ in fields() if key == name]
    if len(loc) == 1:
        near = nearest(name, Settings.model_fields)
        near = near and f"[{near}]"
    else:
        near = nearest(name, [key for table, key, _ in fields() if table == loc[0]])
        near = near and f"{loc[0]}.{near}"
    found = next(iter(same), near)
    return f"did you mean {found}?" if found else ""


def nearest(name: str, names: Iterable[str]) -> str | None:
    """Return the name that was probably meant, if one is similar."""
    return next(iter(difflib.get_close_matches(name, names, n=1)), None)
