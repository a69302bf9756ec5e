"""SIGTERM and SIGINT stop a daemon, SIGHUP reloads its configuration."""

from __future__ import annotations

import signal
import sys
from types import FrameType

from touchd.service.loop import Service


def stop_on_signals(service: Service) -> None:
    """Stop the service in order on SIGTERM or SIGINT; a second one ends the process at once."""

    def handle(number: int, _frame: FrameType | None) -> None:
        service.stop()
        signal.signal(number, signal.SIG_DFL)

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)


def reload_on_hangup(service: Service) -> None:
    """Reload the configuration on SIGHUP; a daemon in a terminal ends with it, one under nohup ignores it."""
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN or (sys.stdin is not None and sys.stdin.isatty()):
        return
    signal.signal(signal.SIGHUP, lambda _number, _frame: service.reload())
