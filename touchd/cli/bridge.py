"""What the verbs of bridges share: signals, and the service manager."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING

from touchd.bridges.bridge import Output, run
from touchd.bridges.screen import HoldOff
from touchd.cli.output import say
from touchd.service.signals import stopping
from touchd.service.systemd import Notifier

if TYPE_CHECKING:  # a bridge does without pydantic's 20 MB
    from touchd.config.schema import InputSettings


def serve(address: str | None, settings: InputSettings, output: Output, what: str) -> None:
    """Run a bridge until SIGTERM, SIGINT or SIGHUP, and report to the service manager meanwhile."""
    if settings.hold_off:
        output = HoldOff(output)
    with stopping() as stop, closing(Notifier.from_environment()) as notifier:

        def goes_on(now_ns: int) -> bool:
            notifier.ready()  # once it has subscribed
            notifier.beat(now_ns)
            return not stop.is_set()

        say(f"touchd: {what} is there", err=True)
        notifier.status(what)
        run(address, output, goes_on)
        notifier.stopping()
