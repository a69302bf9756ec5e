"""`touchd config`: print the effective configuration."""

from __future__ import annotations

from pathlib import Path

import click

from touchd.cli.options import config_option
from touchd.config.load import Retired, load
from touchd.config.render import render
from touchd.config.schema import Settings
from touchd.errors import ConfigError
from touchd.files import is_missing
from touchd.sinks.endpoint import refuse_insecure


@click.command()
@config_option
@click.option("--default", is_flag=True, help="Print the defaults, to copy keys from.")
def command(config: Path | None, default: bool) -> None:
    """Print the effective configuration as TOML: every key with its value, default, range and meaning.

    Environment variables override the configuration file, which overrides the defaults. An invalid file is reported
    with all its errors, and so are keys that do not fit the model's plate, or are asked for and not there. A key of an
    earlier version gets a warning.
    """
    settings = Settings() if default else load(config, retired=_warn)
    refuse_insecure(settings.bus)
    if settings.keypad.layout is not None or settings.input.keypad:
        _check_keys(settings)
    click.echo(render(settings), nl=False)


def _check_keys(settings: Settings) -> None:
    """Raise ConfigError if the keys cannot be used, or if a keypad has none.

    The shipped model's plate is no device's: until a model is installed, keys may lie anywhere.
    """
    from touchd.keypad import load_layout
    from touchd.service.models import installed_path, load_model

    model = None if is_missing(settings.model.path or installed_path()) else load_model(settings)
    if settings.keypad.layout is not None:
        load_layout(settings.keypad.layout, model.description.plate if model else None, "keypad.layout")
    elif model is not None and model.description.layout is None:
        raise ConfigError("there are no keys to type", "input.keypad", "set keypad.layout")


def _warn(key: Retired) -> None:
    click.echo(f"touchd: {key.where}: a setting that is gone is ignored; instead: {key.instead}", err=True)
