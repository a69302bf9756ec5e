"""The loop of a bridge: from the bus to an output, until it is stopped."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from touchd.bridges.following import Down, Following
from touchd.client import Subscriber
from touchd.errors import BusTimeout
from touchd.event import Event, KeyEvent

_BEAT_S = 0.25
"""Longest time between two looks at what is not on the bus: silence, signals, the watchdog of 2 s."""


class Output(Protocol):
    """Where a bridge shows the fingers."""

    @property
    def topics(self) -> tuple[str, ...]:
        """What it needs of the bus."""

    def show(self, down: Down, t_ns: int) -> None:
        """Show the fingers that are down now."""

    def press(self, event: KeyEvent) -> None:
        """Show a key's press or release."""

    def idle(self, now_ns: int) -> None:
        """Do what is due with time; called every 0.25 s or sooner."""

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
    output : Output
    goes_on : callable
        Asked every 0.25 s or sooner, with the time, ns; False ends the bridge.
    clock : callable
        CLOCK_MONOTONIC, ns.

    Raises
    ------
    BusError
        The address cannot be used, or what comes is no message of touchd.
    """
    following = Following()
    events: Subscriber[Event]
    try:
        with Subscriber(address, output.topics) as events:
            while goes_on(now_ns := clock()):
                output.idle(now_ns)
                try:
                    event = events.receive(following.patience_s(now_ns, _BEAT_S))
                except BusTimeout:
                    if following.check(now_ns := clock()):
                        output.show(following.down, now_ns)
                    continue
                now_ns = clock()
                if following.take(event, now_ns) or following.check(now_ns):
                    output.show(following.down, event.t_ns)
                if isinstance(event, KeyEvent):
                    output.press(event)
    finally:
        output.close()
