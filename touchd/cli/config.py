"""`touchd config`: print the effective configuration."""

from __future__ import annotations

from pathlib import Path

import click

from touchd.cli.options import config_option
from touchd.config.load import Retired, load
from touchd.config.render import render
from touchd.config.schema import Settings
from touchd.sinks.endpoint import refuse_insecure


@click.command()
@config_option
@click.option("--default", is_flag=True, help="Print the defaults, to copy keys from.")
def command(config: Path | None, default: bool) -> None:
    """Print the effective configuration as TOML: every key with its value, default, range and meaning.

    Environment variables override the configuration file, which overrides the defaults. An invalid file is reported
    with all its errors, and so is a layout of keys that does not fit the model's plate. A key of an earlier version
    gets a warning.
    """
    settings = Settings() if default else load(config, retired=_warn)
    refuse_insecure(settings.bus)
    if settings.keypad.layout is not None:
        # Late: the keys must lie on the plate that the model knows, and a model takes a moment to load.
        from touchd.service.models import layout_of, load_model

        layout_of(settings, load_model(settings))
    click.echo(render(settings), nl=False)


def _warn(key: Retired) -> None:
    click.echo(f"touchd: {key.where}: a setting that is gone is ignored; instead: {key.instead}", err=True)
