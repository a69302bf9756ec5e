"""Read the configuration: command line over environment over file over defaults; explain what is wrong in it."""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_settings import BaseSettings, EnvSettingsSource, InitSettingsSource, SettingsConfigDict

from touchd.config.render import expected, expected_item, fields, is_secret, section, toml_value, variable
from touchd.config.schema import RETIRED, Settings
from touchd.errors import ConfigError
from touchd.files import read_toml

DEFAULT_PATH = Path("/etc/touchd/touchd.toml")
"""Read if it exists and no other file is named."""
NOT_SETTINGS = frozenset({"TOUCHD_DEBUG"})
"""Environment variables with touchd's prefix that set no key."""
_PREFIX = "TOUCHD_"
_REMOVE = "remove it; `touchd config --default` prints every key"
_Loc = tuple[int | str, ...]
"""Pydantic's location of a value: table, key, index in a list."""


class _Layer(NamedTuple):
    """The settings of one place: the command line, the environment or the file."""

    where: str
    content: dict[str, Any]
    by_variable: bool = False
    """A message names the variable `TOUCHD_BUS__BIND`, not the key `bus.bind`."""

    def holds(self, loc: _Loc) -> bool:
        """Return whether this layer sets the table or key at `loc`."""
        layer: Any = self.content
        for part in loc[:2]:
            if not isinstance(layer, Mapping) or part not in layer:
                return False
            layer = layer[part]
        return True

    def place(self, loc: _Loc) -> str:
        """Return where the value at `loc` stands, for a message."""
        key, items = ".".join(map(str, loc[:2])), "".join(f"[{part}]" for part in loc[2:])
        name = variable(*map(str, loc[:2])) if self.by_variable and len(loc) > 1 else key + items
        return f"{self.where}: {name}"


class Retired(NamedTuple):
    """A key of an earlier version that the configuration still has. It is ignored."""

    where: str
    instead: str
    """What took its place."""


def load(
    path: Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    retired: Callable[[Retired], object] = lambda _: None,
) -> Settings:
    """Return the settings in effect.

    The file of `path` must exist; without a path, /etc/touchd/touchd.toml is read if it exists. `overrides` are the
    command line's settings: `{"bus": {"bind": [...]}}`. `retired` is called for each key of an earlier version, once
    for each place that has it.

    Raises ConfigError with every mistake: where it stands, what the value must be, and what to do.
    """
    problems: list[ConfigError] = []
    layers = [
        _Layer("command line", dict(overrides or {})),
        _Layer("environment", _environment(problems), by_variable=True),
        _Layer(str(path or DEFAULT_PATH), _file(path)),
    ]
    for report in _drop_retired(layers):
        retired(report)
    settings = Settings()
    try:
        sources = [InitSettingsSource(_Layered, layer.content) for layer in layers]
        settings = Settings(**dict(_Layered(sources=sources)))  # type: ignore[call-arg]  # not a field: see there
    except ValidationError as error:
        problems += _explained(error, layers)
    if len(problems) > 1:
        every = "; ".join(map(str, problems))
        raise ConfigError(f"{len(problems)} problems: {every}", "configuration", "correct them all")
    if problems:
        raise problems[0]
    return settings


def empty_file(path: Path | None = None) -> Path | None:
    """Return the file that `load` reads if it has no setting, or is not there; else None."""
    return None if _file(path) else path or DEFAULT_PATH


class _Layered(Settings, BaseSettings):
    """The settings as pydantic-settings merges them: the first of `sources` that has a key wins."""

    # The file's names are case-sensitive: the table [Bus] is a mistake. Variables may have any case.
    model_config = SettingsConfigDict(env_prefix=_PREFIX, env_nested_delimiter="__", case_sensitive=True)

    @classmethod
    def settings_customise_sources(cls, settings_cls: Any, init_settings: Any, *_: Any, **__: Any) -> Any:  # noqa: ARG003 - pydantic's
        """Return the sources given on construction, in place of pydantic's own."""
        return tuple(init_settings()["sources"])


class _Environment(EnvSettingsSource):
    """The variables that name a key."""

    def __init__(self, values: Mapping[str, str]) -> None:
        super().__init__(_Layered, case_sensitive=False)
        self.env_vars = {name.lower(): value for name, value in values.items()}

    def decode_complex_value(self, field_name: str, field: FieldInfo, value: Any) -> Any:  # noqa: ARG002 - pydantic's
        """Read a list as JSON, or with commas between its items."""
        try:
            return json.loads(value)
        except (ValueError, RecursionError):
            return [item.strip() for item in value.split(",")]


def _environment(problems: list[ConfigError]) -> dict[str, Any]:
    known = [variable(table, key) for table, key, _ in fields()]
    gone = [variable(*name.split(".")) for name in RETIRED]
    tables = [f"{_PREFIX}{table.upper()}" for table in Settings.model_fields]
    values: dict[str, str] = {}
    for name, value in os.environ.items():
        upper = name.upper()
        if not upper.startswith(_PREFIX) or upper in NOT_SETTINGS:
            continue
        where = f"environment: {name}"
        if upper in tables:
            problems.append(ConfigError("names a whole table", where, f"name one of its keys: {upper}__KEY"))
        elif upper not in (*known, *gone):
            # Without the prefix, which makes all of them alike.
            names = [one.removeprefix(_PREFIX) for one in (*known, *NOT_SETTINGS)]
            near = _nearest(upper.removeprefix(_PREFIX), names)
            fix = f"did you mean {_PREFIX}{near}?" if near else _REMOVE
            problems.append(ConfigError("unknown variable", where, fix))
        elif any("\ud800" <= character <= "\udfff" for character in value):
            problems.append(ConfigError("is not UTF-8", where, "set it again"))
        else:
            values[name] = value
    return _Environment(values)()


def _file(path: Path | None) -> dict[str, Any]:
    try:
        # Not by TomlConfigSettingsSource: it ignores a missing file, a folder and a pipe.
        return read_toml(path or DEFAULT_PATH, ConfigError)
    except ConfigError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise
        if path is None:
            return {}
        raise ConfigError("no such file", str(path), "check the path") from error


def _drop_retired(layers: list[_Layer]) -> Iterator[Retired]:
    """Remove the keys of earlier versions from the layers, and yield where each stood."""
    for name, instead in RETIRED.items():
        table, key = name.split(".")
        for layer in layers:
            if layer.holds((table, key)):
                layer.content[table] = {k: v for k, v in layer.content[table].items() if k != key}
                yield Retired(layer.place((table, key)), instead)


def _explained(error: ValidationError, layers: Sequence[_Layer]) -> list[ConfigError]:
    """Explain each of pydantic's findings once, in plain words. `layers` are in order of precedence."""
    found = error.errors(include_url=False, include_context=False)
    # A bad item makes the whole list bad: the item is enough.
    return [
        _explain(e["type"], e["loc"], e["input"], e["msg"], layers)
        for e in found
        if not any(len(other["loc"]) > len(e["loc"]) and other["loc"][: len(e["loc"])] == e["loc"] for other in found)
    ]


def _explain(kind: str, loc: _Loc, value: Any, message: str, layers: Sequence[_Layer]) -> ConfigError:
    key = ".".join(map(str, loc[:2]))
    places = [layer.place(loc) for layer in layers if layer.holds(loc)]
    where = next(iter(places), key)
    if kind == "extra_forbidden":
        return ConfigError("unknown key" if len(loc) > 1 else "unknown table or key", where, _suggest(loc) or _REMOVE)
    if len(loc) < 2:
        return ConfigError(f"is {_shown(key, value)}, must be a table", where, f"write [{key}], and its keys below it")
    field = section(str(loc[0])).model_fields[str(loc[1])]
    fix = f"correct it, or leave it out for the default, {toml_value(field.default)}"
    if not places:
        fix = f"set it: the default, {toml_value(field.default)}, does not fit other settings"
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


def _suggest(loc: _Loc) -> str:
    """Suggest the key of this name in any table, or one of a similar name in this table."""
    name = str(loc[-1])
    same = [f"{table}.{key}" for table, key, _ in fields() if key == name]
    if len(loc) == 1:
        near = _nearest(name, Settings.model_fields)
        near = near and f"[{near}]"
    else:
        near = _nearest(name, [key for table, key, _ in fields() if table == loc[0]])
        near = near and f"{loc[0]}.{near}"
    found = next(iter(same), near)
    return f"did you mean {found}?" if found else ""


def _nearest(name: str, names: Iterable[str]) -> str | None:
    """Return the name that was probably meant, if one is similar."""
    return next(iter(difflib.get_close_matches(name, names, n=1)), None)
