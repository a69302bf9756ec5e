"""`touchd tuio`: touches for installations, as TUIO over UDP."""

from __future__ import annotations

import ipaddress
import socket
import time
from functools import partial
from pathlib import Path

import click

from touchd.bridges.area import Area
from touchd.bridges.tuio import Tuio
from touchd.cli.bridge import serve
from touchd.cli.options import bus_option, config_option
from touchd.cli.output import say
from touchd.config.apart import load_apart
from touchd.errors import BridgeError, ConfigError, InsecureBind


@click.command()
@click.option("--to", metavar="HOST:PORT", help="Where to send them.  [default: tuio.to]")
@bus_option
@config_option
def command(to: str | None, address: str | None, config: Path | None) -> None:
    """Send the touches that a running daemon publishes as TUIO 1.1 over UDP.

    /tuio/2Dcur, and /tuio/2Dblb for contacts with sizes. Coordinates are shares of the screen that `[input]` in the
    configuration describes: see `touchd map`. An address beyond loopback takes `tuio.insecure = true`: TUIO has no
    encryption.
    """
    overrides = {"tuio": {"to": to}} if to else {}
    found = load_apart(config, overrides)
    area = Area(found.input)
    where = destination(found.tuio.to, insecure=found.tuio.insecure)
    output = Tuio(area, where, found.device.name, time.monotonic_ns(), partial(say, err=True))
    serve(address, found.input, output, f"TUIO to {found.tuio.to}")


def destination(to: str, *, insecure: bool) -> tuple[str, int]:
    """Return host and port.

    Raises ConfigError for a name without an address, InsecureBind beyond loopback, unless that is allowed; BridgeError
    if nobody can be asked for a name's address now: at boot the network may come later than this.
    """
    host, _, port = to.rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
    except (OSError, ValueError) as error:  # ValueError: of a name that cannot be encoded
        if isinstance(error, socket.gaierror) and error.errno == socket.EAI_AGAIN:
            fix = "start it again, as systemd does, once the network is there, or write the address in numbers"
            raise BridgeError(
                f"nobody knows the address at present ({error.strerror})", f"tuio.to {to}", fix
            ) from error
        found = []
    if not found:
        raise ConfigError("is no HOST:PORT of UDP", f"tuio.to {to}", "write for example 127.0.0.1:3333")
    reached = str(found[0][4][0])
    if not insecure and not ipaddress.ip_address(reached.partition("%")[0]).is_loopback:
        raise InsecureBind(
            "is beyond loopback, where anybody can read what is touched", f"tuio.to {to}",
            "send to 127.0.0.1, or set tuio.insecure = true",
        )  # fmt: skip
    return reached, int(port)
