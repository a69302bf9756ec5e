"""Who is connected to the bus, what each has subscribed to, and who is cut off for taking more than a subscriber needs.

libzmq accepts every connection, and stores what a peer subscribes to at some fifty bytes a character, without a limit.
Its monitor names the descriptor of each connection, and each message that of the connection it came by: so every
connection is counted, and one that breaks a limit is shut down. Its peer may connect again.
"""

from __future__ import annotations

import fcntl
import resource
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import zmq

from touchd.sinks.arrivals import ACCEPTED, DISCONNECTED, UNKNOWN_KEY, Arrivals
from touchd.sinks.authenticator import KEY
from touchd.sinks.throttle import Throttle

MOST_SUBSCRIPTIONS = 64
"""Of one connection; there are four topics."""
MOST_SUBSCRIBED_BYTES = 1024
"""All of one connection's subscriptions together."""
MOST_MESSAGES = 256
"""Messages of one connection at once; further ones at `MESSAGES_HZ`."""
MESSAGES_HZ = 16.0
STALLED_S = 10.0
"""A connection whose peer has read nothing for this time is cut off: what waits for it is stale, and takes memory."""
WITHDRAWN_S = 10.0
"""A connection is cut off once its client's key has been missing for this time: a folder may be rewritten."""
UNSUBSCRIBED_S = 60.0
"""A connection is cut off if it has not subscribed to anything by then: libzmq waits for ever for some that speak no
ZMTP. A subscriber's own connects again."""
_LOOK_S = 1.0
_SHARE = 0.25  # of the time since the last poll: a flood of connections must not delay a frame
_MOST_EVENTS = 64  # read at once, after a pause
_SRCFD = int(zmq.SRCFD)
_SIOCOUTQ, _SIOCOUTQNSD = 0x5411, 0x894B


@dataclass(slots=True)
class _Peer:
    """One connection."""

    descriptor: int
    number: int
    """Of the connection: descriptors are used again."""
    name: str
    """For the log: address and port, or process and user."""
    origin: str
    """What the connections of one peer have in common: its address, or its process."""
    since_s: float
    stream: bool
    """Whether it is TCP."""
    prefixes: set[bytes] = field(default_factory=set)
    size_bytes: int = 0
    credit: float = MOST_MESSAGES
    credit_s: float = 0.0
    subscribed: bool = False
    """Whether it ever subscribed."""
    unsent: bytes = b""
    """How much waits to be sent, as the kernel says it."""
    unsent_s: float = 0.0
    """Since when it has been so much."""
    key: str = ""
    """Its key, if it had to have one."""
    known_s: float = 0.0
    """When that was last known."""


class Peers:
    """The connections of a publisher, and the topics that they want.

    The publisher is an XPUB socket with XPUB_VERBOSER, not bound yet. It has `most` connections at once, and at most
    half of the process's descriptors. One more takes the place of one that has not subscribed, or of one of a peer that
    has several more; else it is refused.
    """

    def __init__(
        self,
        publisher: zmq.Socket[bytes],
        topics: tuple[str, ...],
        most: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.wanted: frozenset[str] = frozenset()
        """The topics that somebody has subscribed to."""
        self.admits: Callable[[str], bool] = lambda _key: True
        """Whether a key is known, by which a client was admitted."""
        self._topics = {topic: topic.encode() for topic in topics}
        self._most = min(most, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
        self._clock = clock
        self._peers: dict[int, _Peer] = {}
        self._wants: Counter[str] = Counter()
        self._looked_s = self._read_s = clock()
        self._cut_off = Throttle("subscriber cut off")
        self._refused = Throttle("subscriber refused")
        self._failed = 0  # kind of event
        self._entered = 0  # number of the last connection that `poll` took in
        self._arrivals = Arrivals(publisher, self._most)

    def guard(self, path: Path) -> None:
        """Hide a socket file of the publisher from newcomers while there are far too many; else keep it there."""
        self._arrivals.guard(path)

    def poll(self) -> None:
        """Take in who came and went, and cut off who stopped reading.

        A socket file that somebody has removed comes back; BusError if it cannot.
        """
        self._follow_arrivals()
        now_s = self._clock()
        if now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            self._arrivals.look()
            for peer in list(self._peers.values()):
                if not peer.subscribed and now_s - peer.since_s >= UNSUBSCRIBED_S:
                    self._cut(peer, f"it has subscribed to nothing for {UNSUBSCRIBED_S:g} s")
                    continue
                self._judge_backlog(peer, now_s)
                if not peer.key or self.admits(peer.key):
                    peer.known_s = now_s
                elif now_s - peer.known_s >= WITHDRAWN_S:
                    self._cut(peer, "its key is known no longer")

    def take(self, message: zmq.Frame) -> frozenset[str]:
        """Account for a message from a peer. Return the topics that it subscribes to."""
        try:
            descriptor = int(message.get(_SRCFD))
        except zmq.ZMQError:
            return frozenset()  # libzmq's own, when the last subscriber of a prefix went: `poll` sees it go
        # Its sender may have come since the last poll, and in the place of another that has left.
        self._arrivals.take_in()
        number = self._arrivals.numbers.get(descriptor, 0)
        if number > self._entered:
            self._enter(descriptor, number)
        peer = self._peers.get(descriptor)
        if peer is None or peer.number != number:
            return frozenset()
        if not peer.key:
            with suppress(zmq.ZMQError):  # of a file, or a bus without a folder of keys
                peer.key = str(message.get(KEY))
        now_s = self._clock()
        peer.credit = min(MOST_MESSAGES, peer.credit + (now_s - peer.credit_s) * MESSAGES_HZ) - 1
        peer.credit_s = now_s
        content = message.bytes
        kind, prefix = content[:1], content[1:]
        new: frozenset[str] = frozenset()
        if kind == b"\x01":
            new = self._matched(prefix)
            peer.subscribed = True
            if prefix not in peer.prefixes:
                peer.prefixes.add(prefix)
                peer.size_bytes += len(prefix)
                self._count(new, 1)
        elif kind == b"\x00" and prefix in peer.prefixes:
            peer.prefixes.remove(prefix)
            peer.size_bytes -= len(prefix)
            self._count(self._matched(prefix), -1)
        if len(peer.prefixes) > MOST_SUBSCRIPTIONS or peer.size_bytes > MOST_SUBSCRIBED_BYTES:
            self._cut(peer, "it subscribes to too much")
        elif peer.credit < 0:
            self._cut(peer, "it sends too much")
        else:
            return new
        return frozenset()

    def close(self) -> None:
        """Stop watching: nobody wants anything."""
        self.wanted = frozenset()
        self._arrivals.close()

    # -- connections ------------------------------------------------------------------------------------

    def _follow_arrivals(self) -> None:
        """Take in who came and went, for a share of the time since the last call."""
        before_s, self._read_s = self._read_s, self._clock()
        until_s = self._read_s + _SHARE * (self._read_s - before_s)
        events = self._arrivals.events
        for _ in range(min(_MOST_EVENTS, len(events))):
            kind, descriptor, number = events.popleft()
            if kind == ACCEPTED:
                self._entered = number
                self._enter(descriptor, number)
            elif kind == DISCONNECTED:
                self._leave(descriptor, number)
            else:  # the disconnection of the same connection follows
                self._failed = kind
            if self._clock() > until_s:
                break

    def _enter(self, descriptor: int, number: int) -> None:
        known = self._peers.get(descriptor)
        if known is not None and known.number >= number:
            return
        self._forget(descriptor)
        name, origin, stream = "gone already", "", True
        with suppress(OSError), _borrowed(descriptor) as connection:
            name, origin = _names(connection)
            stream = connection.family != socket.AF_UNIX
        now_s = self._clock()
        newcomer = _Peer(descriptor, number, name, origin, now_s, stream, credit_s=now_s, known_s=now_s)
        if len(self._peers) >= self._most:
            self._cut(self._choose(newcomer), f"there are more than {self._most}")
            if len(self._peers) >= self._most:
                return
        self._peers[descriptor] = newcomer

    def _leave(self, descriptor: int, number: int) -> None:
        failed, self._failed = self._failed, 0
        peer = self._peers.get(descriptor)
        if peer is None or peer.number != number:
            return
        self._forget(descriptor)
        if failed == UNKNOWN_KEY:
            return  # the authenticator has told
        if failed:
            self._refused.warn(peer=peer.name, reason="its keys do not fit, or it has none")
        elif not peer.subscribed:  # libzmq itself ends a connection that sends too long a message, or no ZMTP
            self._refused.warn(peer=peer.name, reason="it left before it subscribed, or sent what no subscriber does")

    def _forget(self, descriptor: int) -> None:
        peer = self._peers.pop(descriptor, None)
        if peer is not None:
            for prefix in peer.prefixes:
                self._count(self._matched(prefix), -1)

    def _choose(self, newcomer: _Peer) -> _Peer:
        """Return who must go for a newcomer: the newcomer, if all others have subscribed and it has as many."""
        held = Counter(peer.origin for peer in self._peers.values())
        idle = [peer for peer in self._peers.values() if not peer.prefixes]
        if idle:
            return max(idle, key=lambda peer: (held[peer.origin], -peer.since_s))
        heaviest = max(self._peers.values(), key=lambda peer: (held[peer.origin], peer.since_s))
        return heaviest if held[heaviest.origin] > held[newcomer.origin] + 1 else newcomer

    def _judge_backlog(self, peer: _Peer, now_s: float) -> None:
        try:
            unsent = fcntl.ioctl(peer.descriptor, _SIOCOUTQNSD if peer.stream else _SIOCOUTQ, bytes(4))
        except OSError:
            return
        if unsent != peer.unsent or not any(unsent):
            peer.unsent, peer.unsent_s = unsent, now_s
        elif now_s - peer.unsent_s >= STALLED_S:
            self._cut(peer, f"it has read nothing for {STALLED_S:g} s")

    def _cut(self, peer: _Peer, reason: str) -> None:
        self._cut_off.warn(peer=peer.name, reason=reason)
        self._forget(peer.descriptor)
        with suppress(OSError), _borrowed(peer.descriptor) as connection:
            if _names(connection)[0] != peer.name:
                return  # closed meanwhile, and its number given to another
            connection.shutdown(socket.SHUT_RDWR)
            # What has arrived goes too: libzmq would take it in message by message.
            while connection.recv(1 << 16, socket.MSG_DONTWAIT):
                pass

    # -- topics -----------------------------------------------------------------------------------------

    def _matched(self, prefix: bytes) -> frozenset[str]:
        return frozenset(topic for topic, frame in self._topics.items() if frame.startswith(prefix))

    def _count(self, topics: frozenset[str], change: int) -> None:
        for topic in topics:
            self._wants[topic] += change
        if topics:
            self.wanted = frozenset(topic for topic, count in self._wants.items() if count > 0)


@contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """Yield a socket object for libzmq's descriptor, which stays open."""
    connection = socket.socket(fileno=descriptor)
    try:
        yield connection
    finally:
        connection.detach()


def _names(connection: socket.socket) -> tuple[str, str]:
    """Return a connection's name for the log, and its origin."""
    if connection.family == socket.AF_UNIX:
        credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        process, user, _group = struct.unpack("3i", credentials)
        return f"process {process} of user {user}", f"process {process}"
    host, port = connection.getpeername()[:2]
    return f"{host}:{port}", str(host)
