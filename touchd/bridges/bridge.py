"""The loop of a bridge, from the bus to an output; and which fingers are down, as the bus and its silence say.

A finger never stays down by mistake.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from touchd.client import Subscriber
from touchd.errors import BusTimeout
from touchd.event import SILENCE_NS, Contact, Event, HealthEvent, KeyEvent, TouchEvent

Down = dict[int, Contact]
"""The contacts that are down, each under a number that this process never uses again."""
_WAIT_S, _BEAT_NS = 0.25, 100_000_000
"""Longest wait for the bus, and least time between two looks at what is not on it: signals, the watchdog of 2 s."""


class Following:
    """Follows the contacts of one daemon.

    | what comes | what is down then |
    |---|---|
    | a `touch` message | what it names |
    | no `touch` message for 0.3 s | nothing |
    | a `touch` message without contacts: this process stood still | nothing |
    | a `health` message whose state is not `streaming` | nothing |

    After the start and after such a lift, a contact counts only from its next `down`: nobody knows what a finger that
    has been there all along means.
    """

    def __init__(self) -> None:
        self.down: Down = {}
        self._numbers: dict[int, int] = {}  # by the daemon's id, which a restarted daemon uses again
        self._ignored: set[int] = set()
        self._joining = True
        self._next = 1
        self._heard_ns = 0

    def take(self, event: Event, now_ns: int) -> bool:
        """Update `down` by an event that came at `now_ns`; return whether there is something to show."""
        if not isinstance(event, TouchEvent):
            return isinstance(event, HealthEvent) and event.state != "streaming" and self.lift()
        if not event.contacts:  # this subscriber stood still, and messages were dropped
            return self.lift()
        self._heard_ns = now_ns
        if self._joining or self._ignored:
            present = {contact.id for contact in event.contacts if contact.phase != "up"}
            self._ignored = present if self._joining else self._ignored & present
            self._joining = False
        before, numbers, down = self._numbers, {}, {}
        for contact in event.contacts:
            if contact.phase == "up":
                continue
            if contact.phase == "down":  # a new finger, even under an id that was in use: the daemon restarted
                self._ignored.discard(contact.id)
                before.pop(contact.id, None)
            elif contact.id in self._ignored:
                continue
            number = before.get(contact.id)
            if number is None:
                number, self._next = self._next, self._next + 1
            numbers[contact.id] = number
            down[number] = contact
        self._numbers, self.down = numbers, down
        return True

    def check(self, now_ns: int) -> bool:
        """Lift all if the daemon has been silent for too long; return whether there is something to show."""
        return bool(self.down) and now_ns - self._heard_ns >= SILENCE_NS and self.lift()

    def patience_s(self, now_ns: int, most_s: float) -> float:
        """Return how long to wait for the next event, at most `most_s`."""
        if not self.down:
            return most_s
        return min(most_s, max(0.0, (self._heard_ns + SILENCE_NS - now_ns) * 1e-9))

    def lift(self) -> bool:
        """Lift all; return whether anything was down."""
        lifted = bool(self.down)
        self.down = {}
        self._numbers.clear()
        self._joining = True
        return lifted


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


def run(address: str | None, output: Output, goes_on: Callable[[int], bool]) -> None:
    """Show what the daemon publishes at `address`; lift all fingers at the end, after errors too.

    The bus is by default that of the installed service, or of a `touchd` on this computer. `goes_on` is asked every
    0.35 s or sooner, with the time, ns; False ends the bridge.

    Raises BusError if the address cannot be used, or what comes is no message of touchd.
    """
    following = Following()
    events: Subscriber[Event]
    try:
        with Subscriber(address, output.topics) as events:
            now_ns = due_ns = time.monotonic_ns()
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
                    if following.check(now_ns := time.monotonic_ns()):
                        output.show(following.down, now_ns)
                    wait_s = following.patience_s(now_ns, _WAIT_S)
                    continue
                now_ns = time.monotonic_ns()
                if following.take(event, now_ns) or following.check(now_ns):
                    output.show(following.down, event.t_ns)
                if isinstance(event, TouchEvent):
                    wait_s = _WAIT_S  # the patience after a touch is longer
                    continue
                # A press whose finger does not count would never be released if the daemon ended now.
                if isinstance(event, KeyEvent) and (following.down or event.phase == "release"):
                    output.press(event)
                wait_s = following.patience_s(now_ns, _WAIT_S)
    finally:
        output.close()
