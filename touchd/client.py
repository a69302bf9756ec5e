"""Receive touches in a Python program.

::

    from touchd.client import Subscriber

    with Subscriber() as events:
        for event in events:
            for c in event.contacts:
                print(c.id, c.phase, c.x_mm, c.y_mm)
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections import Counter
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Generic, Self, TypeVar, overload

import zmq

from touchd.errors import BusError, BusTimeout
from touchd.event import SILENCE_NS, TOPICS, Event, KeyEvent, TouchEvent
from touchd.sinks import curve, endpoint
from touchd.sinks.reconnect import Reconnect
from touchd.sinks.stream import Stream, decode_message

DEFAULT_ADDRESS = endpoint.LOOPBACK
"""Of a `touchd` that runs without a service manager."""
SERVICE_ADDRESS = endpoint.SERVICE
"""Of the installed service."""
MAX_AGE_S = 0.5
"""Older touches are dropped unless a subscriber asks for another age, s."""
_FOR_EVER = -1  # to ZeroMQ
_LONGEST_WAIT_S = 2_000_000.0  # that ZeroMQ can count in milliseconds
_RCVMORE = int(zmq.RCVMORE)  # pyzmq looks an enum's members up in each call
_MOST_BYTES = 1 << 24  # of a message: libzmq ends a connection that brings more, for good
_MOST_DEVICES = 256  # that share an address
_MOST_DRAINED = 1000  # messages read for one event
_LOOK_S = SILENCE_NS * 1e-9  # who waits looks this often whether it was closed, and whether touches fell silent


# Unless other topics are asked for, a type checker sees an iterator of touches.
E = TypeVar("E", bound=Event)
_Key = str | PathLike[str] | None


class Subscriber(Generic[E]):
    """A subscription to the event bus: an iterator of events, and a context manager that ends it.

    It may be made before the daemon runs, and outlives a restart of it. Messages that the bus repeats, for another
    subscriber's sake, are left out. So are stale ones, which waited while this program or the connection stood still.
    A finger that was down by then is lifted first, and so is one of which no message came for 0.3 s, as the daemon
    hangs or is gone: an event without contacts, and without an `up`. Each key that is pressed is released before.

    Parameters
    ----------
    address : str, optional
        `tcp://HOST:PORT` or `ipc:///PATH`; by default the installed service, or else a `touchd` on this computer.
    topics : Iterable[str]
        Of `touchd.event.TOPICS`; an empty string stands for all. One may be given alone.
    timeout_s : float or None
        How long to wait for each event; None waits for ever.
    server_key : path or None
        The daemon's public key file, if it has keys.
    client_key_file : path or None
        This client's secret key file; without it a key is made up, which a daemon without `curve_clients` accepts.
    max_age_s : float or None
        Touches, keys and spectra older than this are dropped; None drops and lifts none, for programs that want all in
        order. Of another computer's daemon the age is the delay beyond the least one seen, so the first is never old.
    newest_only : bool
        Of the messages that wait, return each topic's newest alone, and every key. A tap may begin and end between two
        reads, and is then not seen.

    Raises
    ------
    BusError
        If the address, a topic or a key cannot be used, or files or threads are short; when iterating, if a message is
        not one of the bus.
    BusTimeout
        When iterating, if there was no event for `timeout_s`.
    """

    @overload
    def __init__(
        self: Subscriber[TouchEvent], address: str | None = ..., *, timeout_s: float | None = ...,
        server_key: _Key = ..., client_key_file: _Key = ..., max_age_s: float | None = ..., newest_only: bool = ...,
    ) -> None: ...  # fmt: skip

    @overload
    def __init__(
        self: Subscriber[Event], address: str | None = ..., topics: Iterable[str] = ..., timeout_s: float | None = ...,
        server_key: _Key = ..., client_key_file: _Key = ..., max_age_s: float | None = ..., newest_only: bool = ...,
    ) -> None: ...  # fmt: skip

    def __init__(
        self,
        address: str | None = None,
        topics: Iterable[str] = ("touch",),
        timeout_s: float | None = None,
        server_key: _Key = None,
        client_key_file: _Key = None,
        max_age_s: float | None = MAX_AGE_S,
        newest_only: bool = False,
    ) -> None:
        addresses = endpoint.defaults(SERVICE_ADDRESS, DEFAULT_ADDRESS) if address is None else (address,)
        self.address = " or ".join(addresses)
        self.topics = (topics,) if isinstance(topics, str) else tuple(topics)
        self.timeout_s = timeout_s
        self.lost: Counter[str] = Counter()
        """Messages that never arrived, by topic: those skipped by `seq`."""
        self.dropped: Counter[str] = Counter()
        """Messages that arrived but were stale, or not the newest, by topic."""
        self._max_age_s = math.inf if max_age_s is None else max_age_s
        self._newest_only = newest_only
        self._waiting: dict[object, Event] = {}
        self._streams: dict[str, Stream] = {}
        unknown = [topic for topic in self.topics if topic and topic not in TOPICS]
        if unknown or not self.topics:
            what = f"there is no topic {unknown[0]!r}" if unknown else "no topic is asked for"
            raise BusError(what, self.address, f"choose from {', '.join(TOPICS)}")
        if not self._max_age_s >= 0:
            raise BusError("the largest age must be 0 s or more", self.address, "give seconds, or None")
        server, pair = None, None
        if server_key is not None:
            server = curve.load_public(Path(server_key))
            pair = curve.load_secret(Path(client_key_file)) if client_key_file is not None else None
            pair = pair or curve.KeyPair(*zmq.curve_keypair())
        elif client_key_file is not None:
            raise BusError("a client key is of no use without the server's", self.address, "name the server's key, too")
        self._keyed = pair is not None
        endpoint.refuse_without_resources(self.address)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._reconnect: Reconnect | None = None
        self._waits_s = math.inf  # in a call that receives
        self._lifts = False  # what was returned last was a silent device's: it may have more
        self._process = os.getpid()
        self._lock = threading.RLock()  # a signal's handler may close while its thread receives
        self._receiving = self._closed = False
        try:
            self._socket.setsockopt(zmq.LINGER, 0)
            self._socket.setsockopt(zmq.MAXMSGSIZE, _MOST_BYTES)
            # A daemon whose computer lost power is noticed after half a minute, and looked for again.
            for option, value in ((zmq.TCP_KEEPALIVE, 1), (zmq.TCP_KEEPALIVE_IDLE, 15), (zmq.TCP_KEEPALIVE_INTVL, 5),
                                  (zmq.TCP_KEEPALIVE_CNT, 3)):  # fmt: skip
                self._socket.setsockopt(option, value)
            if server is not None and pair is not None:
                self._socket.setsockopt(zmq.CURVE_SERVERKEY, server)
                self._socket.setsockopt(zmq.CURVE_PUBLICKEY, pair.public)
                self._socket.setsockopt(zmq.CURVE_SECRETKEY, pair.secret)
                self._reconnect = Reconnect(self._socket, addresses)
            # Touches are repeated while a key is pressed: who asks for keys alone needs their silence, too.
            lifts = "key" in self.topics and self._max_age_s < math.inf
            self._unasked = "touch" if lifts and not {"touch", ""} & set(self.topics) else None
            for topic in (*self.topics, self._unasked) if self._unasked else self.topics:
                self._socket.setsockopt(zmq.SUBSCRIBE, topic.encode())
            if len(addresses) == 1 and endpoint.is_file(self.address):
                endpoint.refuse_forbidden(self.address)
            for one in addresses:
                self._connect(one)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> E:
        if not self._closed:
            try:
                return self.receive(self.timeout_s)
            except BusError:
                if not self._closed:
                    raise
        raise StopIteration

    def receive(self, timeout_s: float | None = None) -> E:
        """Return the next event, waiting for it at most `timeout_s`, or for ever if None.

        Raises BusTimeout if there was none, BusError if a message is not one of the bus, or the subscription is closed.
        """
        if os.getpid() != self._process:  # libzmq would wait for ever
            raise BusError("made before this process was forked", self.address, "make a Subscriber in each process")
        if timeout_s is not None and math.isnan(timeout_s):
            raise BusError("the time to wait is not a number", self.address, "give seconds, or None")
        with self._lock:
            self._receiving = True
            try:
                return self._receive(math.inf if timeout_s is None else timeout_s)
            finally:
                self._receiving = False
                if self._closed:
                    self._end()

    def close(self) -> None:
        """End the subscription, and within 0.3 s what another thread waits for; further calls do nothing."""
        self._closed = True
        if os.getpid() == self._process:  # a forked one has nothing open
            with self._lock:
                if not self._receiving:
                    self._end()

    def _end(self) -> None:
        if self._reconnect is not None:
            self._reconnect.close()
        self._socket.close()
        self._context.term()

    def _receive(self, timeout_s: float) -> E:
        deadline_s, left_s = time.monotonic() + timeout_s, timeout_s
        drained = len(self._waiting)
        while drained < _MOST_DRAINED or (left_s > 0 and not self._waiting):
            if self._closed:
                raise BusError("the subscription is closed", self.address, "make another Subscriber")
            parts = self._received(0.0 if self._waiting or self._lifts else min(left_s, _LOOK_S))
            if parts is None:
                # Nothing is touched, or a key is released, on a device whose touches fell silent.
                silent = (stream.lift_silent() for stream in self._streams.values())
                new, lifted = next((event for event in silent if event is not None), None), self._lifts
                self._lifts = new is not None
                if new is None and not lifted and (self._waiting or left_s <= 0):
                    break
            else:
                event = decode_message(parts, self.address)
                new = None if event is None else self._stream(event.device).take(event)
                drained += 1
            if new is not None and new.type != self._unasked:
                if not self._newest_only:
                    return new  # type: ignore[return-value]  # the topics asked for decide what E is
                self._keep(new)
            left_s = deadline_s - time.monotonic()
        if self._waiting:
            return self._waiting.pop(next(iter(self._waiting)))  # type: ignore[return-value]  # as above
        raise BusTimeout(
            f"no {' or '.join(repr(topic) for topic in self.topics) or 'topic'} message within {timeout_s:g} s",
            self.address,
            "check that the daemon runs, that bus.bind has this address"
            + (", and that it knows both keys" if self._keyed else ", and whether it asks for keys"),
        )

    def _connect(self, address: str) -> None:
        if address.startswith("tcp://"):
            endpoint.split(address)  # libzmq would try an impossible port for ever
        try:
            self._socket.setsockopt(zmq.IPV6, int("[" in address))
            self._socket.connect(address)
        except (zmq.ZMQError, UnicodeError) as error:  # of a name on the command line that is no UTF-8
            raise BusError(
                f"not an address ({getattr(error, 'strerror', 'no UTF-8')})",
                address,
                f"write tcp://HOST:PORT or ipc:///PATH, for example {DEFAULT_ADDRESS}",
            ) from error

    def _keep(self, event: Event) -> None:
        """Let the event wait in place of an older one of its topic."""
        key = (event.seq, event.phase) if isinstance(event, KeyEvent) else None  # a silent daemon's have one `seq`
        source = (event.device, event.type, key)
        if self._waiting.pop(source, None) is not None:
            self.dropped[event.type] += 1
        self._waiting[source] = event

    def _stream(self, device: str) -> Stream:
        stream = self._streams.get(device)
        if stream is None:
            if len(self._streams) == _MOST_DEVICES:
                del self._streams[next(iter(self._streams))]
            stream = self._streams[device] = Stream(self._max_age_s, self.lost, self.dropped)
        return stream

    def _received(self, timeout_s: float) -> list[bytes] | None:
        """Return the parts of the next message, None if none comes in time."""
        # To wait in the call that receives is 7 us quicker than to poll first, of 70 from the socket to here.
        if timeout_s != self._waits_s:
            wait_ms = _FOR_EVER if timeout_s > _LONGEST_WAIT_S else max(0, math.ceil(timeout_s * 1000))
            self._socket.setsockopt(zmq.RCVTIMEO, wait_ms)
            self._waits_s = timeout_s
        try:
            parts = [self._socket.recv()]
        except zmq.Again:
            if self._reconnect is not None:
                self._reconnect.look()
            return None
        while self._socket.get(_RCVMORE):
            parts.append(self._socket.recv())
        return parts
