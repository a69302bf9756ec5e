"""`touchd web`: look at the plate in a browser."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import Any

import click

from touchd.cli.options import PATH, bus_option, config_option
from touchd.cli.output import say
from touchd.config.apart import load_apart
from touchd.errors import RecordingMissing
from touchd.service.systemd import Notifier


@click.command()
@click.option("--bind", "where", default="127.0.0.1:8770", show_default=True, metavar="HOST:PORT",
              help="Where to serve, on loopback.")  # fmt: skip
@click.option("--origin", "origins", multiple=True, metavar="URL",
              help="Also serve pages of a reverse proxy at URL, for example https://plate.example.")  # fmt: skip
@click.option("--keypad", is_flag=True, help="Show touches in keypad mode, too: whoever looks can read the PIN.")
@click.option("--wizard", "wizard", type=PATH, metavar="FILE",
              help="Socket of touchd wizard.  [default: the service's, or yours]")  # fmt: skip
@click.option("--replay", type=PATH, metavar="RECORDING", help="Also show a recording, frame by frame.")
@bus_option
@config_option
@click.pass_obj
def command(
    above: dict[str, Any] | None,
    where: str,
    origins: tuple[str, ...],
    keypad: bool,
    wizard: Path | None,
    replay: Path | None,
    address: str | None,
    config: Path | None,
) -> None:
    """Serve a page that shows the plate live, and checks the set-up; print its address.

    The address holds a token behind its `#`, for views that act; each start draws a new one. The server is reached from
    this computer alone.
    """
    from touchd.calibration.wizard import default_socket
    from touchd.service.log import configure
    from touchd.web.guards import Access
    from touchd.web.hub import Hub
    from touchd.web.server import bind, serve
    from touchd.web.site import Site

    if replay is not None and not os.path.exists(replay):  # by os: of a name too long for any file, too
        raise RecordingMissing("no such recording", str(replay), "check the path")
    found = load_apart(config)
    configure(found.log)
    with closing(bind(where)) as listening, closing(Notifier.from_environment()) as manager:
        host, port = listening.getsockname()[:2]
        shown = f"[{host}]" if ":" in host else host
        access = Access(port, origins, watched=bool(keypad or origins or replay))
        hub = Hub(address, shows_keys=keypad)
        site = Site(
            access, hub, config=config, address=address,
            screen_mm=tuple(found.input.screen_mm), replay=replay, wizard=wizard or default_socket(),
        )  # fmt: skip
        url = f"http://{shown}:{port}/#token={access.token}"
        debug = bool((above or {}).get("debug"))
        try:
            hub.open()
            serve(site, listening, lambda: say(f"touchd: open {url}"), manager, debug=debug)
        finally:
            hub.stop()
