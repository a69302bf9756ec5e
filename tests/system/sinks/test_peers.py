"""What a stranger on the bus cannot do to the others."""

from __future__ import annotations

import os
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zmq
from structlog.testing import capture_logs

from tests.processes import wait_until
from tests.system.hostile import stranger
from tests.system.hostile.stranger import NULL_GREETING, PATIENCE_S, connect, greeted, message, topics
from touchd.config.schema import BusSettings
from touchd.event import TOPICS, Contact, SpectrumEvent, TouchEvent
from touchd.sinks import peers, zeromq
from touchd.sinks.peers import MOST_MESSAGES, MOST_SUBSCRIBED_BYTES, MOST_SUBSCRIPTIONS, Peers
from touchd.sinks.zeromq import ZeromqSink

Log = list[Any]


def touch(seq: int) -> TouchEvent:
    contact = Contact(1, "move", 12.34, 56.78, 0.5, 1.5, 0.99, 0.0, 0.0)
    return TouchEvent("plate", seq, seq, "2025-01-01T00:00:00.000000Z", seq, [contact])


@pytest.fixture(params=["tcp", "ipc"])
def sink(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[ZeromqSink]:
    """A bus for four subscribers."""
    address = "tcp://127.0.0.1:*" if request.param == "tcp" else f"ipc://{tmp_path}/bus"
    sink = ZeromqSink(BusSettings(bind=(address,), max_subscribers=4))
    yield sink
    sink.close()


@pytest.fixture
def log() -> Iterator[Log]:
    with capture_logs() as lines:
        yield lines


@pytest.fixture
def honest(sink: ZeromqSink) -> Iterator[zmq.Socket[bytes]]:
    """A subscriber to everything, which has heard a touch."""
    with zmq.Context() as context, context.socket(zmq.SUB) as listener:
        listener.setsockopt(zmq.LINGER, 0)
        listener.setsockopt(zmq.SUBSCRIBE, b"touch")
        listener.setsockopt(zmq.SUBSCRIBE, b"spectrum")
        listener.connect(sink.addresses[0])
        until(sink, lambda: sink.wants("touch") and sink.wants("spectrum"))
        yield listener


def until(sink: ZeromqSink, done: Callable[[], object]) -> None:
    """Poll the sink as the daemon would until something holds."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < give_up_s
        sink.poll()
        time.sleep(0.004)


class Flood:
    """A publisher for two, a slow clock, and more connections than it has looked at yet."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], address: str, number: int) -> None:
        self.now_s = 0.0
        self.publisher = context.socket(zmq.XPUB)
        self.publisher.setsockopt(zmq.XPUB_VERBOSER, 1)
        self.peers = Peers(self.publisher, TOPICS, 2, self._clock)
        self.publisher.bind(address)
        self.connections = [greeted(address) for _ in range(number)]
        wait_until(lambda: len(self.peers._arrivals.events) >= number)  # a thread reads them

    def _clock(self) -> float:
        self.now_s += 0.001
        return self.now_s

    def cut_by(self, elapsed_s: float) -> int:
        """Poll after a time, and return how many connections are left."""
        self.now_s += elapsed_s
        self.peers.poll()
        for one in [one for one in self.connections if ended(one)]:
            self.connections.remove(one)
            one.close()
        return len(self.connections)

    def close(self) -> None:
        self.peers.close()
        for one in self.connections:
            one.close()
        self.publisher.close(linger=0)


@pytest.fixture
def flood(tmp_path: Path) -> Iterator[Flood]:
    with zmq.Context() as context, closing(Flood(context, f"ipc://{tmp_path}/flood", 100)) as flood:
        yield flood


def test_flood(flood: Flood) -> None:
    """Connections take a quarter of the time between two frames, at any frame rate."""
    left = [flood.cut_by(0.001 * elapsed_ms) for elapsed_ms in (8, 1, 1, 8)]
    assert 92 <= left[-1] < 100
    assert left[0] > left[2]
    while flood.cut_by(1.0) > 2:
        pass


def test_subscriber_in_a_flood(flood: Flood) -> None:
    """A subscription counts though the connections before it have not been looked at yet."""
    flood.connections[-1].sendall(message(b"\x01touch"))
    assert flood.publisher.poll(int(PATIENCE_S * 1000))
    assert flood.peers.take(flood.publisher.recv(copy=False)) == {"touch"}
    assert flood.peers.wanted == {"touch"}
    while flood.cut_by(1.0) > 2:
        pass
    assert flood.peers.wanted == {"touch"}


def test_a_subscriber_in_the_place_of_another(tmp_path: Path) -> None:
    """Who subscribes with the descriptor of one that has just left is not taken for it."""
    with zmq.Context() as context, closing(Flood(context, f"ipc://{tmp_path}/bus", 1)) as bus:

        def subscribe() -> int:
            bus.connections[-1].sendall(message(b"\x01touch"))
            assert bus.publisher.poll(int(PATIENCE_S * 1000))
            frame = bus.publisher.recv(copy=False)
            assert bus.peers.take(frame) == {"touch"}
            return int(frame.get(zmq.SRCFD))

        first, files = subscribe(), len(os.listdir("/proc/self/fd"))
        bus.connections.pop().close()
        wait_until(lambda: len(os.listdir("/proc/self/fd")) <= files - 2)  # both ends
        bus.publisher.recv(copy=False)  # libzmq's own word for the one that left
        bus.connections.append(greeted(f"ipc://{tmp_path}/bus"))
        assert subscribe() == first
        bus.cut_by(1.0)
        assert bus.peers.wanted == {"touch"}


def ended(connection: socket.socket) -> bool:
    """Return whether the daemon has ended the connection."""
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def received(connection: socket.socket, text: bytes) -> bool:
    try:
        return text in connection.recv(65536)
    except BlockingIOError:
        return False


def reasons(log: Log) -> list[str]:
    return [line["reason"] for line in log if line["event"] == "subscriber cut off"]


def is_heard(sink: ZeromqSink, listener: zmq.Socket[bytes]) -> bool:
    sink.publish(touch(7), 0)

    def heard() -> bool:
        return bool(listener.poll(0)) and b'"seq":7' in listener.recv_multipart()[1]

    until(sink, heard)
    return True


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (topics(8, MOST_SUBSCRIPTIONS + 1), "subscribes to too much"),
        (topics(400, 1 + MOST_SUBSCRIBED_BYTES // 400), "subscribes to too much"),
        (message(b"hello") * (MOST_MESSAGES + 100), "sends too much"),
        (message(b"\x01key") * (MOST_MESSAGES + 100), "sends too much"),
        ((message(b"\x01key") + message(b"\x00key")) * MOST_MESSAGES, "sends too much"),
    ],
    ids=["many", "long", "no subscriptions", "the same again", "on and off"],
)
def test_greed(sink: ZeromqSink, honest: zmq.Socket[bytes], log: Log, content: bytes, reason: str) -> None:
    """Who subscribes to too much or sends too much is cut off and logged; others hear on."""
    with greeted(sink.addresses[0]) as greedy:
        greedy.sendall(content)
        until(sink, lambda: ended(greedy))
    assert [reason in said for said in reasons(log)] == [True]
    assert is_heard(sink, honest)
    assert sink.wants("touch")


def test_too_long_a_topic(sink: ZeromqSink, honest: zmq.Socket[bytes], log: Log) -> None:
    """A topic of 4 kB ends its connection before it is stored."""
    with greeted(sink.addresses[0]) as greedy:
        greedy.sendall(topics(4000, 1))
        until(sink, lambda: ended(greedy))
        until(sink, lambda: any("no subscriber does" in line["reason"] for line in log))
    assert is_heard(sink, honest)


def test_what_was_cut_off_leaves_nothing(sink: ZeromqSink) -> None:
    """The topics of a connection that is cut off are wanted no more."""
    with greeted(sink.addresses[0]) as greedy:
        greedy.sendall(message(b"\x01key"))
        until(sink, lambda: sink.wants("key"))
        greedy.sendall(topics(8, 100))
        until(sink, lambda: ended(greedy))
    assert not any(sink.wants(topic) for topic in TOPICS)


@pytest.mark.parametrize("topic", ["touch", "spectrum"])
def test_nobody_ends_another_s_subscription(sink: ZeromqSink, honest: zmq.Socket[bytes], topic: str) -> None:
    """The end of a subscription that never was, or was the sender's own, silences nobody."""
    with greeted(sink.addresses[0]) as forger:
        forger.sendall(message(b"\0" + topic.encode()) + message(b"\x01key"))
        until(sink, lambda: sink.wants("key"))
        assert sink.wants(topic)
        forger.sendall(message(b"\1" + topic.encode()) + message(b"\0" + topic.encode()) + message(b"\0key"))
        until(sink, lambda: not sink.wants("key"))
        assert sink.wants(topic)
    sink.publish(SpectrumEvent("plate", 7, 0, "2025-01-01T00:00:00.000000Z", 1, [1.0]), 0)
    until(sink, lambda: honest.poll(0))
    assert honest.recv_multipart()[0] == b"spectrum"


def test_idle_connections_give_way(sink: ZeromqSink, log: Log) -> None:
    """Connections that say nothing cannot keep a subscriber out."""
    idle = [connect(sink.addresses[0]) for _ in range(7)]
    until(sink, lambda: sum(map(ended, idle)) == 3)
    with greeted(sink.addresses[0]) as newcomer:
        newcomer.sendall(message(b"\x01touch"))
        until(sink, lambda: sink.wants("touch"))
    for connection in idle:
        connection.close()
    assert "more than 4" in reasons(log)[0]


def test_a_connection_without_a_subscription_is_cut_off(
    sink: ZeromqSink, honest: zmq.Socket[bytes], log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What asks for a web page, which libzmq takes for a peer of its first protocol, ends; a subscriber stays."""
    monkeypatch.setattr(peers, "UNSUBSCRIBED_S", 0.3)
    monkeypatch.setattr(peers, "_LOOK_S", 0.1)
    with connect(sink.addresses[0]) as scanner:
        scanner.sendall(b"GET / HTTP/1.0\r\n\r\n")
        until(sink, lambda: ended(scanner))
    assert ["subscribed to nothing" in reason for reason in reasons(log)] == [True]
    assert is_heard(sink, honest)


def test_subscribers_do_not_give_way(sink: ZeromqSink, honest: zmq.Socket[bytes]) -> None:
    """When all places are taken by subscribers, the next one is refused until one leaves."""
    sink.publish(touch(1), 0)
    others = [greeted(sink.addresses[0]) for _ in range(3)]
    for other in others:
        other.setblocking(False)
        other.sendall(message(b"\x01touch"))
        until(sink, partial(received, other, b'"seq":1'))
    with connect(sink.addresses[0]) as late:
        until(sink, lambda: ended(late))
    with zmq.Context() as context, context.socket(zmq.SUB) as patient:
        patient.setsockopt(zmq.LINGER, 0)
        patient.setsockopt(zmq.SUBSCRIBE, b"health")
        patient.connect(sink.addresses[0])
        others.pop().close()
        until(sink, lambda: patient.poll(0) or sink.wants("health"))  # it subscribes again while it is read
    assert is_heard(sink, honest)
    for other in others:
        other.close()


@pytest.mark.parametrize("sink", ["ipc"], indirect=True)
def test_a_crowd_between_two_frames(sink: ZeromqSink) -> None:
    """However many come at once, libzmq accepts some: the file is hidden meanwhile, and there again for a newcomer."""
    address, crowd = sink.addresses[0], list[socket.socket]()
    path, give_up_s = Path(address.removeprefix("ipc://")), time.monotonic() + PATIENCE_S
    with suppress(FileNotFoundError):
        while time.monotonic() < give_up_s:
            with suppress(BlockingIOError):  # libzmq has not accepted the last ones yet
                crowd.append(connect(address))
    assert not path.exists()
    assert len(crowd) < 1000
    until(sink, path.exists)
    for connection in crowd:
        connection.close()
    with greeted(address) as newcomer:
        newcomer.sendall(message(b"\x01touch"))
        until(sink, lambda: sink.wants("touch"))
    sink.close()
    assert not list(path.parent.glob(".*.shut"))


def test_reserve(log: Log) -> None:
    """Subscribers get half of the process's descriptors, even if `max_subscribers` is more."""
    limits, few = resource.getrlimit(resource.RLIMIT_NOFILE), 256
    resource.setrlimit(resource.RLIMIT_NOFILE, (few, limits[1]))
    try:
        sink = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",), max_subscribers=4096))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    with closing(sink), ExitStack() as stack:
        for _ in range(few // 2 + 3):  # each is accepted, and has no limit of time
            stack.enter_context(greeted(sink.addresses[0]))
        until(sink, lambda: reasons(log))
    assert f"more than {few // 2}" in reasons(log)[0]


def test_handshake(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who greets and then waits is ended: an unfinished handshake holds no place for long."""
    monkeypatch.setattr(zeromq, "_HANDSHAKE_MS", 300)
    with closing(ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)))) as sink, connect(sink.addresses[0]) as slow:
        slow.sendall(NULL_GREETING)
        begin_s = time.monotonic()
        until(sink, lambda: ended(slow))
        assert time.monotonic() - begin_s < 25, "libzmq's own limit is 30 s"


def test_backlog() -> None:
    """What waits in the kernel for a subscriber that does not read is bounded, and the rest is dropped."""
    settings = BusSettings(bind=("tcp://127.0.0.1:*",), high_water_mark=1)
    body = SpectrumEvent("plate", 1, 0, "2025-01-01T00:00:00.000000Z", 1, [0.1] * 8000)
    with closing(ZeromqSink(settings)) as sink, greeted(sink.addresses[0]) as silent:
        silent.sendall(message(b"\x01spectrum"))
        until(sink, lambda: sink.wants("spectrum"))
        for _ in range(300):  # 10 MB
            sink.publish(body, 0)
            time.sleep(0.002)  # the reader has time to take it, and does not
        received_bytes = 0
        silent.settimeout(1.0)
        with suppress(TimeoutError):
            while part := silent.recv(1 << 20):
                received_bytes += len(part)
    assert received_bytes < 1_000_000, "by default there are megabytes"


@pytest.mark.parametrize("sink", ["ipc"], indirect=True)
def test_a_process_that_holds_all_places_gives_way(sink: ZeromqSink, log: Log) -> None:
    """Even subscribers give way to another's, if one process has several more of them."""
    line = [sys.executable, stranger.__file__, "silent", sink.addresses[0], "4"]
    with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as greedy:
        assert greedy.stdout is not None
        greedy.stdout.readline()
        until(sink, lambda: sum(peer.subscribed for peer in sink._peers._peers.values()) == 4)
        with zmq.Context() as context, context.socket(zmq.SUB) as honest:
            honest.setsockopt(zmq.LINGER, 0)
            honest.setsockopt(zmq.SUBSCRIBE, b"touch")
            honest.connect(sink.addresses[0])
            assert is_heard(sink, honest)
        greedy.kill()
    assert [f"process {greedy.pid} " in line["peer"] for line in log] == [True]


def test_who_stops_reading_is_cut_off(
    sink: ZeromqSink, honest: zmq.Socket[bytes], log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A subscriber that does not read for long is cut off, and one that reads is not."""
    monkeypatch.setattr(peers, "STALLED_S", 0.5)
    monkeypatch.setattr(peers, "_LOOK_S", 0.1)
    body = SpectrumEvent("plate", 1, 0, "2025-01-01T00:00:00.000000Z", 1, [0.1] * 4000)
    with greeted(sink.addresses[0]) as silent:
        silent.sendall(message(b"\x01spectrum"))

        def publish() -> bool:
            while honest.poll(0):
                honest.recv_multipart()
            sink.publish(body, 0)
            return bool(reasons(log))

        until(sink, publish)
    assert ["read nothing" in reason for reason in reasons(log)] == [True]
    while honest.poll(100):
        honest.recv_multipart()
    assert is_heard(sink, honest)
