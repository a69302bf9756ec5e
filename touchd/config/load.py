"""Loading the configuration: options over environment over file over defaults, and every mistake explained at once."""

from __future__ import annotations

import difflib
import json
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_settings import BaseSettings, EnvSettingsSource, SettingsConfigDict

from touchd.config.render import expected, expected_item, fields, is_secret, section, toml_value, variable
from touchd.config.schema import Settings
from touchd.errors import ConfigError

DEFAULT_PATH = Path("/etc/touchd/touchd.toml")
"""Read when no file is named, if it exists."""
NOT_SETTINGS = frozenset({"TOUCHD_DEBUG"})
"""Environment variables with our prefix that are no settings."""
_PREFIX = "TOUCHD_"
_TOML_ERROR = re.compile(r"(?P<what>.*) \(at (?P<place>line \d+, column \d+|end of document)\)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class _Problem:
    where: str
    what: str
    fix: str


def load(path: Path | None = None, overrides: Mapping[str, Any] | None = None) -> Settings:
    """Return the settings in effect.

    Parameters
    ----------
    path : Path, optional
        A TOML file, which must exist; unset, /etc/touchd/touchd.toml is read if it exists.
    overrides : mapping, optional
        What the command line asks for: `{"bus": {"bind": [...]}}` or `{"bus.bind": [...]}`. None means not given.

    Raises
    ------
    ConfigError
        With all that is wrong: where it stands, what it must be, and what to do.
    """
    problems: list[_Problem] = []
    layers = [
        ("command line: {key}", _nested(overrides or {})),
        ("environment: {variable}", _environment(problems)),
        (f"{path or DEFAULT_PATH}: {{key}}", _file(path)),
    ]
    merged: dict[str, Any] = {}
    for _, layer in reversed(layers):
        merged = _merge(merged, layer)
    settings = Settings()
    try:
        settings = Settings.model_validate(merged)
    except ValidationError as error:
        problems += _explain_all(error, layers)
    if len(problems) == 1:
        raise ConfigError(problems[0].what, problems[0].where, problems[0].fix)
    if problems:
        list_of_all = "; ".join(f"{p.where}: {p.what} -> {p.fix}" for p in problems)
        raise ConfigError(f"{len(problems)} problems: {list_of_all}", "configuration", "correct them all")
    return settings


def _nested(overrides: Mapping[str, Any]) -> dict[str, Any]:
    layer: dict[str, Any] = {}
    for key, value in overrides.items():
        for part in reversed(key.split(".")):
            value = {part: _nested(value) if isinstance(value, Mapping) else value}
        layer = _merge(layer, {k: v for k, v in value.items() if v is not None})
    return layer


def _merge(low: Mapping[str, Any], high: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(low)
    for key, value in high.items():
        if isinstance(value, Mapping) and isinstance(merged.get(key), Mapping):
            merged[key] = _merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def _file(path: Path | None) -> dict[str, Any]:
    where = path or DEFAULT_PATH
    try:
        return tomllib.loads(where.read_bytes().decode())
    except FileNotFoundError as error:
        if path is None:
            return {}
        raise ConfigError("no such file", str(path), "check the path") from error
    except OSError as error:
        raise ConfigError(
            f"cannot be read ({error.strerror})", str(where), "check the path and its permissions"
        ) from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ConfigError("is not UTF-8", f"{where}: line {line}", "save the file as UTF-8") from error
    except (ValueError, RecursionError) as error:
        found = _TOML_ERROR.fullmatch(str(error))
        what = found["what"] if found else str(error)
        place = f"{where}: {found['place']}" if found else str(where)
        raise ConfigError(f"is not valid TOML: {what[:1].lower()}{what[1:]}", place, "correct this line") from error


class _Schema(Settings, BaseSettings):
    """The settings, as pydantic-settings asks for them in order to read the environment."""

    model_config = SettingsConfigDict(env_prefix=_PREFIX, env_nested_delimiter="__")


class _Environment(EnvSettingsSource):
    """The environment variables that name a key."""

    def __init__(self, values: Mapping[str, str]) -> None:
        super().__init__(_Schema)
        self.env_vars = {name.lower(): value for name, value in values.items()}

    def decode_complex_value(self, field_name: str, field: FieldInfo, value: Any) -> Any:  # noqa: ARG002 - pydantic's
        """Take a list as JSON, or with commas between its items."""
        try:
            return json.loads(value)
        except (ValueError, RecursionError):
            return [item.strip() for item in value.split(",")]


def _environment(problems: list[_Problem]) -> dict[str, Any]:
    known = {variable(table, key): f"{table}.{key}" for table, key, _ in fields()}
    tables = {f"{_PREFIX}{table.upper()}": table for table in Settings.model_fields}
    values: dict[str, str] = {}
    for name, value in os.environ.items():
        upper = name.upper()
        if not upper.startswith(_PREFIX) or upper in NOT_SETTINGS:
            continue
        where = f"environment: {name}"
        if upper in tables:
            problems.append(_Problem(where, "names a whole table", f"name one of its keys: {upper}__KEY"))
        elif upper not in known:
            near = _nearest(upper, [*known, *NOT_SETTINGS])
            problems.append(_Problem(where, "unknown variable", f"did you mean {near}?" if near else _REMOVE))
        elif any("\ud800" <= character <= "\udfff" for character in value):
            problems.append(_Problem(where, "is not UTF-8", "set it again"))
        else:
            values[name] = value
    return _Environment(values)()


_REMOVE = "remove it; `touchd config --default` prints every key"


def _explain_all(error: ValidationError, layers: list[tuple[str, Any]]) -> list[_Problem]:
    """Say in plain words, and once, what pydantic found."""
    found = error.errors(include_url=False, include_context=False)
    # A bad item makes the whole list bad: the item is enough.
    return [
        _explain(e["type"], e["loc"], e["input"], e["msg"], layers)
        for e in found
        if not any(len(other["loc"]) > len(e["loc"]) and other["loc"][: len(e["loc"])] == e["loc"] for other in found)
    ]


def _explain(
    kind: str, loc: tuple[int | str, ...], value: Any, message: str, layers: list[tuple[str, Any]]
) -> _Problem:
    key = ".".join(str(part) for part in loc[:2])
    name = key + "".join(f"[{part}]" for part in loc[2:])
    origin = next((place for place, layer in layers if _holds(layer, loc)), "{key}")
    where = origin.format(key=name, variable=variable(*map(str, loc[:2])) if len(loc) > 1 else key)
    if kind == "extra_forbidden":
        return _Problem(where, "unknown key" if len(loc) > 1 else "unknown table or key", _suggest(loc) or _REMOVE)
    if len(loc) < 2:
        return _Problem(where, f"is {_shown(key, value)}, must be a table", f"write [{key}], and its keys below it")
    field = section(str(loc[0])).model_fields[str(loc[1])]
    fix = f"correct it, or leave it out for the default, {toml_value(field.default)}"
    if kind == "value_error":
        return _Problem(where, message.removeprefix("Value error, "), fix)
    wanted = expected(field) if len(loc) == 2 else expected_item(field)
    return _Problem(where, f"is {_shown(key, value)}, must be {wanted}", fix)


def _holds(layer: Any, loc: tuple[int | str, ...]) -> bool:
    for part in loc[:2]:
        if not isinstance(layer, Mapping) or part not in layer:
            return False
        layer = layer[part]
    return True


def _shown(key: str, value: Any) -> str:
    if is_secret(key):
        return "something else (not shown)"
    try:
        text = "empty" if value in ("", [], ()) else repr(value)
    except ValueError:  # a whole number of thousands of digits
        text = "far too large"
    return text if len(text) <= 60 else f"{text[:57]}..."


def _suggest(loc: tuple[int | str, ...]) -> str:
    """Name the key that was probably meant: of this name in any table, or of a similar one in this table."""
    name = str(loc[-1])
    same = [f"{table}.{key}" for table, key, _ in fields() if key == name]
    if len(loc) == 1:
        near = _nearest(name, list(Settings.model_fields))
        near = near and f"[{near}]"
    else:
        near = _nearest(name, [key for table, key, _ in fields() if table == loc[0]])
        near = near and f"{loc[0]}.{near}"
    found = next(iter(same), near)
    return f"did you mean {found}?" if found else ""


def _nearest(name: str, names: list[str]) -> str | None:
    return next(iter(difflib.get_close_matches(name, names, n=1)), None)
