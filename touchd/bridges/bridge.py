"""The loop of a bridge: from the bus to an output, until it is stopped."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from touchd.bridges.following import Down, Following
from touchd.client import Subscriber
from touchd.errors import BusTimeout
from touchd.event import Event, KeyEvent, TouchEvent

_WAIT_S, _BEAT_NS = 0.25, 100_000_000
"""Longest wait for the bus, and least time between two looks at what is not on it: signals, the watchdog of 2 s."""


class Output(Protocol):
    """Where a bridge shows the fingers."""

    @property
    def topics(self) -> tuple[str, ...]:
        """What it needs of the bus."""

    def show(self, down: Down, t_ns: int) -> None:
        """Show the fingers that are down now."""

    def press(self, event: KeyEvent) -> None:  # noqa: ARG002 - for those that have keys
        """Show a key's press or release; most outputs have none."""
        return

    def idle(self, now_ns: int) -> None:  # noqa: ARG002 - for those that look at the clock
        """Do what is due with time, if anything is; called every 0.35 s or sooner."""
        return

    def close(self) -> None:
        """Lift all and end."""


def run(
    address: str | None,
    output: Output,
    goes_on: Callable[[int], bool],
    clock: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Show what the daemon publishes at `address`; lift all fingers at the end, after errors too.

    Parameters
    ----------
    address : str, optional
        The bus; by default the installed service, or a `touchd` on this computer.
    goes_on : callable
        Asked every 0.35 s or sooner, with the time, ns; False ends the bridge.

    Raises BusError if the address cannot be used, or what comes is no message of touchd.
    """
    following = Following()
    events: Subscriber[Event]
    try:
        with Subscriber(address, output.topics) as events:
            now_ns = due_ns = clock()
            wait_s = _WAIT_S
            while True:
                if now_ns >= due_ns:
                    if not goes_on(now_ns):
                        break
                    output.idle(now_ns)
                    due_ns = now_ns + _BEAT_NS
                try:
                    event = events.receive(wait_s)
                except BusTimeout:
                    if following.check(now_ns := clock()):
                        output.show(following.down, now_ns)
                    wait_s = following.patience_s(now_ns, _WAIT_S)
                    continue
                now_ns = clock()
                if following.take(event, now_ns) or following.check(now_ns):
                    output.show(following.down, event.t_ns)
                if isinstance(event, TouchEvent):
                    wait_s = _WAIT_S  # the patience after a touch is longer
                    continue
                if isinstance(event, KeyEvent):
                    output.press(event)
                wait_s = following.patience_s(now_ns, _WAIT_S)
    finally:
        output.close()
