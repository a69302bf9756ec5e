"""`touchd model`: install a model, or go back to the previous one; a running daemon takes it at once."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click

from touchd.cli.options import PATH, config_option
from touchd.cli.screen import socket_option
from touchd.config.load import load
from touchd.config.schema import Settings
from touchd.errors import ModelError
from touchd.service.control import SERVICE_PATH, path_of, take_model

if TYPE_CHECKING:
    from touchd.localization.model import Model


@click.group()
@config_option
@socket_option
@click.pass_context
def command(ctx: click.Context, config: Path | None, socket_path: Path | None) -> None:
    """Change the model of the daemon.

    The model is the file that model.path names, or else one in the service's state directory, or yours. A running
    daemon takes it without a restart, or says why not.
    """
    settings = load(config)
    ctx.obj = settings, socket_path or path_of(settings.control) or SERVICE_PATH


@command.command(name="install", short_help="Put a model in the place of the one in use.")
@click.argument("file", type=PATH)
@click.pass_obj
def install_command(found: tuple[Settings, Path], file: Path) -> None:
    """Copy FILE and the field atlas beside it in the place of the model in use, which is kept as the previous one."""
    from touchd.localization.model_file import install

    _replace(found, lambda target: install(file, target))


@command.command(name="rollback", short_help="Go back to the previous model.")
@click.pass_obj
def rollback_command(found: tuple[Settings, Path]) -> None:
    """Exchange the model in use with the previous one; a second time undoes it."""
    from touchd.localization.model_file import rollback

    _replace(found, rollback)


def _replace(found: tuple[Settings, Path], by: Callable[[Path], Model]) -> None:
    """Put another model in the place of the one in use, and have a running daemon take it."""
    from touchd.localization.model import Model
    from touchd.service.models import installed_path

    settings, socket_path = found
    target = settings.model.path or installed_path()
    before = None
    with suppress(ModelError):  # one that is unusable may be replaced
        before = Model(target, atlas=False).description.acquisition
    model = by(target)
    taken = take_model(socket_path, target)
    told = "the running daemon uses it" if taken else "no daemon runs there, the next one takes it"
    click.echo(f"{target}: {model.description.name}; {told}")
    if not taken and before is not None and model.description.acquisition != before:
        click.echo("it takes other frames than the one before: should the daemon refuse it, touchd model rollback",
                   err=True)  # fmt: skip
