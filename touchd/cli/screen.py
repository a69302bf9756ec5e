"""`touchd screen`: tell the daemon whether the screen is on."""

from __future__ import annotations

from pathlib import Path

import click

from touchd.cli.options import PATH, config_option
from touchd.config.load import load
from touchd.service.control import SERVICE_PATH, path_of, send

socket_option = click.option(
    "--socket", "socket_path", type=PATH, metavar="FILE",
    help=f"The daemon's control socket.  [default: control.socket, or {SERVICE_PATH}]",
)  # fmt: skip


@click.command()
@click.argument("state", type=click.Choice(["off", "on"]))
@socket_option
@config_option
def command(state: str, socket_path: Path | None, config: Path | None) -> None:
    """Tell the running daemon that the screen went off or on.

    While it is off, the daemon locates no touches and only updates the baseline. A daemon starts with the screen on.
    """
    send(socket_path or path_of(load(config).control) or SERVICE_PATH, f"screen {state}")
