"""Receive touches in a Python program.

::

    from touchd.client import Subscriber

    with Subscriber() as events:
        for event in events:
            for c in event.contacts:
                print(c.id, c.phase, c.x_mm, c.y_mm)
"""

from __future__ import annotations

import json
import math
import re
import time
from collections import Counter
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Generic, Self, TypeVar, cast, overload

import msgspec
import zmq

from touchd.errors import BusError, BusTimeout
from touchd.event import TOPICS, VERSION, Event, TouchEvent, decode
from touchd.sinks import curve, endpoint

DEFAULT_ADDRESS = "tcp://127.0.0.1:5570"
_FOR_EVER = -1  # to ZeroMQ


# Unless other topics are asked for, a type checker sees an iterator of touches.
E = TypeVar("E", bound=Event)
_Key = str | PathLike[str] | None


class Subscriber(Generic[E]):
    """A subscription to the event bus: an iterator of events, and a context manager that ends it.

    It may be made before the daemon runs, and outlives a restart of it. The first event of a topic can be an old one:
    the last before the subscription. Messages that the bus repeats, for another subscriber's sake, are left out.

    Parameters
    ----------
    address : str
        `tcp://HOST:PORT` or `ipc:///PATH`.
    topics : Iterable[str]
        Of `touchd.event.TOPICS`; an empty string stands for all.
    timeout_s : float or None
        How long to wait for each event; None waits for ever.
    server_key : path or None
        The daemon's public key file, if it has keys.
    client_key_file : path or None
        This client's secret key file; without it a key is made up, which a daemon without `curve_clients` accepts.

    Raises
    ------
    BusError
        If the address, a topic or a key cannot be used; when iterating, if a message is not one of the bus.
    BusTimeout
        When iterating, if there was no event for `timeout_s`.
    """

    @overload
    def __init__(
        self: Subscriber[TouchEvent], address: str = ..., *, timeout_s: float | None = ...,
        server_key: _Key = ..., client_key_file: _Key = ...,
    ) -> None: ...  # fmt: skip

    @overload
    def __init__(
        self: Subscriber[Event], address: str = ..., topics: Iterable[str] = ..., timeout_s: float | None = ...,
        server_key: _Key = ..., client_key_file: _Key = ...,
    ) -> None: ...  # fmt: skip

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        topics: Iterable[str] = ("touch",),
        timeout_s: float | None = None,
        server_key: _Key = None,
        client_key_file: _Key = None,
    ) -> None:
        self.address = address
        self.topics = tuple(topics)
        self.timeout_s = timeout_s
        self.lost: Counter[str] = Counter()
        """Messages that never arrived, by topic: those skipped by `seq`."""
        self._seen: dict[tuple[str, str], tuple[int, int]] = {}
        for topic in self.topics:
            if topic and topic not in TOPICS:
                raise BusError(f"there is no topic {topic!r}", address, f"choose from {', '.join(TOPICS)}")
        server, pair = None, None
        if server_key is not None:
            server = curve.load_public(Path(server_key))
            pair = curve.load_secret(Path(client_key_file)) if client_key_file is not None else curve.new_pair()
        elif client_key_file is not None:
            raise BusError("a client key is of no use without the server's", address, "name the server's key as well")
        self._keyed = pair is not None
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._wait_ms = _FOR_EVER
        try:
            self._socket.setsockopt(zmq.LINGER, 0)
            # A daemon whose computer lost power is noticed after half a minute, and looked for again.
            for option, value in ((zmq.TCP_KEEPALIVE, 1), (zmq.TCP_KEEPALIVE_IDLE, 15), (zmq.TCP_KEEPALIVE_INTVL, 5),
                                  (zmq.TCP_KEEPALIVE_CNT, 3)):  # fmt: skip
                self._socket.setsockopt(option, value)
            if server is not None and pair is not None:
                self._socket.setsockopt(zmq.CURVE_SERVERKEY, server)
                self._socket.setsockopt(zmq.CURVE_PUBLICKEY, pair.public)
                self._socket.setsockopt(zmq.CURVE_SECRETKEY, pair.secret)
            for topic in self.topics:
                self._socket.setsockopt(zmq.SUBSCRIBE, topic.encode())
            self._socket.setsockopt(zmq.IPV6, int("[" in address))
            self._connect()
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
        if self._socket.closed:
            raise StopIteration
        return self.receive(self.timeout_s)

    def receive(self, timeout_s: float | None = None) -> E:
        """Return the next event, waiting for it at most `timeout_s`, or for ever if None.

        Raises
        ------
        BusTimeout
            If there was none.
        BusError
            If a message is not one of the bus.
        """
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        left_s = timeout_s
        while (parts := self._received(left_s)) is not None:
            event = self._decoded(parts)
            if event is not None and self._is_new(event):
                return cast(E, event)  # the topics asked for decide what E is
            left_s = None if deadline_s is None else deadline_s - time.monotonic()
        raise BusTimeout(
            f"no {' or '.join(repr(topic) for topic in self.topics) or 'topic'} message within {timeout_s:g} s",
            self.address,
            "check that the daemon runs, that bus.bind has this address"
            + (", and that it knows both keys" if self._keyed else ", and whether it asks for keys"),
        )

    def close(self) -> None:
        """End the subscription; further calls do nothing, and an iteration ends."""
        self._socket.close()
        self._context.term()

    def _connect(self) -> None:
        if self.address.startswith("tcp://"):
            endpoint.split(self.address)  # libzmq would try an impossible port for ever
        try:
            self._socket.connect(self.address)
        except zmq.ZMQError as error:
            raise BusError(
                f"not an address ({error.strerror})",
                self.address,
                f"write tcp://HOST:PORT or ipc:///PATH, for example {DEFAULT_ADDRESS}",
            ) from error

    def _received(self, timeout_s: float | None) -> list[bytes] | None:
        """Return the parts of the next message, None if none comes in time."""
        wait_ms = _FOR_EVER if timeout_s is None else max(0, math.ceil(timeout_s * 1000))
        # To wait in the call that receives is 7 us quicker than to poll first, of 70 from the socket to here.
        if wait_ms != self._wait_ms:
            self._socket.setsockopt(zmq.RCVTIMEO, wait_ms)
            self._wait_ms = wait_ms
        try:
            return self._socket.recv_multipart()
        except zmq.Again:
            return None

    def _decoded(self, parts: list[bytes]) -> Event | None:
        """Return the event of a message, or None if its topic is newer than this program."""
        if parts[0] not in _KNOWN:
            return None
        topic = parts[0].decode()
        if len(parts) != 2:
            raise BusError(
                f"a {topic} message of {len(parts)} parts instead of 2", self.address, "is it a touchd that publishes?"
            )
        try:
            event = decode(topic, parts[1])
        except msgspec.DecodeError as error:
            problem = _problem(error)
            version = _version(parts[1])
        else:
            if event.v == VERSION:
                return event
            problem, version = "", event.v
        if version != VERSION:
            raise BusError(
                f"a {topic} message of version {version}, and this program knows {VERSION}",
                self.address,
                "upgrade touchd here",
            )
        raise BusError(f"not a {topic} message ({problem})", self.address, "is it a touchd that publishes?")

    def _is_new(self, event: Event) -> bool:
        """Return whether the event is no repeat, and count those skipped before it."""
        source = (event.device, event.type)
        last = self._seen.get(source)
        now = (event.seq, event.t_ns)
        if now == last:
            return False
        self._seen[source] = now
        # The bus never sends an older message again, so a counter that fell belongs to a restarted daemon.
        if last is not None and event.seq > last[0]:
            self.lost[event.type] += event.seq - last[0] - 1
        return True


def _problem(error: msgspec.DecodeError) -> str:
    """Return which field is wrong; neither its value nor the error itself, which quotes it: a key press is secret."""
    if not isinstance(error, msgspec.ValidationError):
        return "payload: no JSON"
    said, _, where = str(error).rpartition(" - at `")
    expected = re.fullmatch(r"Expected `[a-z |]+`, got `[a-z]+`|Object missing required field `[a-z_]+`", said or where)
    return f"{where.rstrip('`').removeprefix('$.') or 'payload'}: {expected[0] if expected else 'not as agreed'}"


_KNOWN = frozenset(topic.encode() for topic in TOPICS)


def _version(payload: bytes) -> object:
    """Return the version that an undecodable payload claims, or the known one if it claims none."""
    try:
        content = json.loads(payload)
    except ValueError:
        return VERSION
    return content.get("v", VERSION) if isinstance(content, dict) else VERSION
