"""Which fingers are down, as the bus says, and as its silence says: a finger never stays down by mistake."""

from __future__ import annotations

from touchd.event import Contact, Event, HealthEvent, TouchEvent

Down = dict[int, Contact]
"""The contacts that are down, each under a number that this process never uses again."""
SILENCE_NS = 300_000_000
"""The daemon repeats a touch every 0.1 s while a finger is down. After this silence it hangs, or is gone."""


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
