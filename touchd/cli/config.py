"""`touchd config`: what is in effect, as a file that could be loaded."""

from __future__ import annotations

from pathlib import Path

import click

from touchd.config.load import load
from touchd.config.render import render
from touchd.config.schema import Settings


@click.command(name="config", short_help="Print the effective configuration.")
@click.option("--config", "path", type=click.Path(path_type=Path), help="Configuration file (TOML).")
@click.option("--default", is_flag=True, help="Print the defaults instead, as a file to start from.")
@click.pass_context
def command(ctx: click.Context, path: Path | None, default: bool) -> None:
    """Print the effective configuration: every key with its value, default, range and meaning, as TOML.

    It is what the environment and the configuration file make of the defaults. A file that is wrong is explained
    instead, with every mistake in it.
    """
    settings = Settings() if default else load(path or (ctx.obj or {}).get("config"))
    click.echo(render(settings), nl=False)
