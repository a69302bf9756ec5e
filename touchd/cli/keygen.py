"""`touchd keygen`: make CURVE keys for a bus beyond this computer."""

from __future__ import annotations

import json
from pathlib import Path

import click

from touchd.cli.options import PATH
from touchd.sinks.curve import make_files


@click.command()
@click.argument("folder", metavar="DIR", type=PATH)
@click.option("--name", default="touchd", show_default=True, help="Name of the key files.")
def command(folder: Path, name: str) -> None:
    """Make a CURVE key pair in DIR.

    It writes NAME.key, the public key, and NAME.key_secret, which only you can read. The daemon and each client need a
    pair of their own. Existing keys are never overwritten.
    """
    public_path, secret_path = (path.absolute() for path in make_files(folder, name))
    click.echo(f"""\
public key: {public_path}
secret key: {secret_path} (leave it on this computer)

For the daemon, in its configuration:

    [bus]
    curve_secret_key = {json.dumps(str(secret_path))}

  and give {public_path.name} to the clients: --server-key {public_path.name}

For a client: copy {public_path.name} into the folder that the daemon's configuration names as bus.curve_clients.
The client identifies with --client-key {secret_path.name}.""")
