"""What the verbs of bridges share: the option of the bus, signals, and the service manager."""

from __future__ import annotations

import signal
from contextlib import closing
from types import FrameType

import click

from touchd.bridges.bridge import Output, run
from touchd.service.systemd import Notifier

bus_option = click.option(
    "--bus", "address", metavar="ADDRESS",
    help="Where the daemon publishes.  [default: the installed service, or else a touchd on this computer]",
)  # fmt: skip


def serve(address: str | None, output: Output, what: str) -> None:
    """Run a bridge until SIGTERM or SIGINT, and report to the service manager meanwhile."""
    stopped = False

    def stop(_number: int, _frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    with closing(Notifier.from_environment()) as notifier:

        def goes_on(now_ns: int) -> bool:
            notifier.ready()  # once it has subscribed
            notifier.beat(now_ns)
            return not stopped

        click.echo(f"touchd: {what} is there", err=True)
        notifier.status(what)
        run(address, output, goes_on)
        notifier.stopping()
