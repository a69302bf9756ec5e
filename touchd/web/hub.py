"""Newest messages for any number of browsers: threads read the bus, the server's loop hands out.

Nothing is too old to be shown: the page tells the age. The fingers of a daemon that fell silent are lifted. A browser
has one slot for each topic. What it did not fetch in time is replaced, never queued: a touch message names all fingers,
so an older one tells nothing more.
"""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import structlog

from touchd.client import Subscriber
from touchd.errors import BusError, BusTimeout
from touchd.event import Event, HealthEvent, PlateEvent, TouchEvent, encode
from touchd.sinks.throttle import Throttle

TOPICS = ("touch", "health", "plate", "truth")
"""What every browser gets."""
ASKED = ("spectrum",)
"""What the daemon makes only while a browser asks for it."""
PRIVATE = frozenset({"touch", "spectrum", "truth"})
"""A PIN could be read from these."""
MOST_CLIENTS = 32
HISTORY = 300
"""Health messages kept: five minutes."""
_WAIT_S = 0.25
_AGAIN_S = 1.0
"""Between two tries to subscribe."""
_NEVER_OLD_S = 1e9
_PACE_S, _SPECTRUM_PACE_S = 0.026, 0.1
"""Between two looks at the bus: what comes meanwhile and no screen would show is not handed over."""

log = structlog.get_logger()


class Client:
    """One browser: the newest message of each topic that it has not fetched."""

    def __init__(self) -> None:
        self.asked: frozenset[str] = frozenset()
        """Topics of `ASKED` that it wants."""
        self.wake = asyncio.Event()
        self._slots: dict[str, bytes] = {}

    def offer(self, topic: str, payload: bytes) -> None:
        """Put a message in its topic's slot."""
        self._slots[topic] = payload
        self.wake.set()

    def drop(self, topics: frozenset[str]) -> None:
        """Empty the slots of some topics."""
        for topic in topics:
            self._slots.pop(topic, None)

    def take(self) -> list[bytes]:
        """Return what waits, and empty the slots."""
        waiting, self._slots = list(self._slots.values()), {}
        self.wake.clear()
        return waiting


class Hub:
    """Connects the bus to browsers, by default that of the installed service, or of a touchd on this computer.

    With `shows_keys` it hands out touches in keypad mode, too.
    """

    def __init__(self, address: str | None = None, *, shows_keys: bool = False) -> None:
        self.shows_keys = shows_keys
        self.history: deque[bytes] = deque(maxlen=HISTORY)
        self.heard_s = -float("inf")
        """When the last message came, s of the monotonic clock."""
        self.keypad: bool | None = None
        """Whether the daemon is in keypad mode; None before it has said so: then no touch is handed out."""
        self._address = address
        self._clients: set[Client] = set()
        self._last: dict[str, bytes] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopped = threading.Event()
        self._threads: list[threading.Thread] = []
        self._spectrum: threading.Event | None = None
        self._odd = Throttle("not understood")
        self._asked_thread: threading.Thread | None = None  # the last one that listened to it
        self._again: asyncio.TimerHandle | None = None
        self._opened: Subscriber[Event] | None = None  # until a thread has it

    def open(self) -> None:
        """Subscribe; `stop` has to follow. Raises BusError if the address cannot be used."""
        self._opened = self._subscribe(TOPICS)

    def start(self) -> None:
        """Begin to listen; called in the server's loop."""
        self._loop = asyncio.get_running_loop()
        opened, self._opened = self._opened, None
        self._listen(TOPICS, self._stopped, opened)

    def stop(self) -> None:
        """End all threads, and what was opened; further calls do nothing."""
        self._stopped.set()
        if self._opened is not None:
            self._opened.close()
        if self._spectrum is not None:
            self._spectrum.set()
        for thread in self._threads:
            thread.join()

    def join(self) -> Client | None:
        """Add a browser, which gets the last messages at once; None if there are too many."""
        if len(self._clients) >= MOST_CLIENTS:
            return None
        client = Client()
        if self.history:
            client.offer("history", b'{"type":"history","health":[%b]}' % b",".join(self.history))
        for topic, payload in self._last.items():
            if self._may_show(topic):
                client.offer(topic, payload)
        self._clients.add(client)
        return client

    def leave(self, client: Client) -> None:
        """Remove a browser."""
        self._clients.discard(client)
        self._follow_asked()

    def ask(self, client: Client, topics: frozenset[str]) -> None:
        """Set which topics of `ASKED` a browser wants."""
        client.asked = topics & set(ASKED)
        self._follow_asked()

    def publish(self, topic: str, message: dict[str, Any]) -> None:
        """Send a view's own state to all browsers, now and to those to come; called in the server's loop."""
        self._offer(topic, json.dumps({"type": topic, **message}).encode(), keep=True)

    def last(self, topic: str) -> bytes | None:
        """Return the last message of a topic."""
        return self._last.get(topic)

    @property
    def silent_s(self) -> float | None:
        """Time since the daemon was heard, s; None if it never was."""
        silent_s = time.monotonic() - self.heard_s
        return silent_s if silent_s < float("inf") else None

    def _may_show(self, topic: str) -> bool:
        return topic not in PRIVATE or self.keypad is False or (self.keypad is True and self.shows_keys)

    def _follow_asked(self) -> None:
        """Listen to the spectrum while a browser wants it, by one thread at a time: each takes descriptors."""
        wanted = any("spectrum" in client.asked for client in self._clients)
        if not wanted and self._spectrum is not None:
            self._spectrum.set()
            self._spectrum = None
            self._last.pop("spectrum", None)
        elif wanted and self._spectrum is None and not self._stopped.is_set():
            if self._asked_thread is not None and self._asked_thread.is_alive():
                self._follow_later()
                return
            self._spectrum = threading.Event()
            self._asked_thread = self._listen(ASKED, self._spectrum)

    def _follow_later(self) -> None:
        def follow() -> None:
            self._again = None
            self._follow_asked()

        if self._again is None and self._loop is not None:
            self._again = self._loop.call_later(_WAIT_S, follow)

    def _subscribe(self, topics: tuple[str, ...]) -> Subscriber[Event]:
        return Subscriber(self._address, topics, max_age_s=_NEVER_OLD_S, newest_only=True)

    def _listen(
        self, topics: tuple[str, ...], stopped: threading.Event, opened: Subscriber[Event] | None = None
    ) -> threading.Thread:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = threading.Thread(target=self._read, args=(topics, stopped, opened), name="bus", daemon=True)
        self._threads.append(thread)
        thread.start()
        return thread

    def _read(self, topics: tuple[str, ...], stopped: threading.Event, opened: Subscriber[Event] | None) -> None:
        assert self._loop is not None
        hand: Callable[..., object] = self._loop.call_soon_threadsafe
        pace_s = _SPECTRUM_PACE_S if topics == ASKED else _PACE_S
        events = opened or self._subscribed(topics, stopped)
        if events is None:
            return
        with events:
            while not stopped.is_set():
                newest: list[Event] = []
                try:
                    newest.append(events.receive(_WAIT_S))
                    # All topics, then the pause: a truth is of the same frame as the touch before it.
                    while len(newest) < len(topics):
                        newest.append(events.receive(0.0))
                except BusTimeout:
                    pass
                except BusError as error:
                    self._odd.warn(error=str(error))
                    stopped.wait(_AGAIN_S)
                try:
                    hand(self._take, newest)
                except RuntimeError:  # the loop has ended
                    return
                stopped.wait(pace_s)

    def _subscribed(self, topics: tuple[str, ...], stopped: threading.Event) -> Subscriber[Event] | None:
        """Return a subscription; None if `stopped` was set before there was one.

        Another daemon may have come, whose socket this user may not use: the one after it may be usable again. A socket
        that is being made is its owner's alone for a moment.
        """
        told = False
        while not stopped.is_set() or not told:
            try:
                return self._subscribe(topics)
            except BusError as error:
                if not told:
                    log.warning("not listened to, and tried again", topics=topics, error=str(error))
                told = True
            stopped.wait(_AGAIN_S)
        return None

    def _take(self, events: list[Event]) -> None:
        """Take events into the slots of all browsers; runs in the server's loop."""
        for event in events:
            payload = encode(event)
            if isinstance(event, TouchEvent) and not event.contacts:  # the daemon is silent
                self._last.pop("truth", None)
            else:
                self.heard_s = time.monotonic()
            if isinstance(event, PlateEvent):
                self.keypad = bool(event.keys)
            elif isinstance(event, HealthEvent):
                self.history.append(payload)
                if event.state in ("starting", "stopping"):
                    self.keypad = None  # the new one will say
            if not self._may_show("touch"):
                for client in self._clients:
                    client.drop(PRIVATE)
                for topic in PRIVATE:
                    self._last.pop(topic, None)
            self._offer(event.type, payload, keep=event.type != "spectrum")

    def _offer(self, topic: str, payload: bytes, *, keep: bool) -> None:
        if keep:
            self._last[topic] = payload
        if not self._may_show(topic):
            return
        for client in self._clients:
            if topic not in ASKED or topic in client.asked:
                client.offer(topic, payload)
