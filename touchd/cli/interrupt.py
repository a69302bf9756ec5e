"""Read frames until the person at the terminal has had enough: no signal costs what was read."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Event
from types import FrameType
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from touchd.frame import Frame
    from touchd.sources.source import Change, Source

# A signal takes effect within this time while no frame arrives.
_TIMEOUT_S = 0.2


@contextmanager
def stopping() -> Iterator[Event]:
    """Yield an event that SIGINT and SIGTERM set, instead of what else they do."""
    stop = Event()

    def handle(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    with ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM):
            stack.callback(signal.signal, number, signal.signal(number, handle))
        yield stop


def until(stop: Event, source: Source) -> Iterator[Frame | None]:
    """Yield a source's frames until a signal; report what becomes of the device."""
    from touchd.service.runner import frames_of

    def report(change: Change) -> None:
        click.echo(f"device {change.state}: {change.reason}", err=True)

    for frame in frames_of(source, _TIMEOUT_S, on_change=report):
        if stop.is_set():
            return
        yield frame
