"""What the bus promises its subscribers, and the daemon."""

from __future__ import annotations

import itertools
import json
import logging
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq

from touchd.config.schema import BusSettings
from touchd.errors import BusTimeout
from touchd.event import TOPICS, Contact, Event, HealthEvent, KeyEvent, Latency, SpectrumEvent, TouchEvent
from touchd.sinks import zeromq
from touchd.sinks.zeromq import ZeromqSink

Subscribe = Callable[..., zmq.Socket[bytes]]
PATIENCE_S = 60.0
LOCAL = BusSettings(bind=("tcp://127.0.0.1:*",))


def touch(seq: int, fingers: int = 1) -> TouchEvent:
    contacts = [Contact(n, "move", 12.34, 56.78, 0.5, 1.5, 0.99, 0.0, 0.0) for n in range(fingers)]
    return TouchEvent("plate", seq, seq * 8_000_000, "2025-01-01T00:00:00.000000Z", seq, contacts)


def key(seq: int) -> KeyEvent:
    return KeyEvent("plate", seq, 0, "2025-01-01T00:00:00.000000Z", "hush-7", "press", 0.9)


def health(seq: int) -> HealthEvent:
    wall = "2025-01-01T00:00:00.000000Z"
    return HealthEvent("plate", seq, 0, wall, "streaming", 1, 0, 0, {}, 0, Latency(), 1.0, 0.1, "model", "0.1.0")


def spectrum(seq: int) -> SpectrumEvent:
    return SpectrumEvent("plate", seq, 0, "2025-01-01T00:00:00.000000Z", 1, [1.0, 2.0])


@pytest.fixture
def sink() -> Iterator[ZeromqSink]:
    ticks = itertools.count(1_000_000, 1_000)
    sink = ZeromqSink(LOCAL, clock=lambda: next(ticks))
    yield sink
    sink.close()


@pytest.fixture
def subscribe() -> Iterator[Subscribe]:
    """Return a function that makes subscribers of a sink, closed when the test ends."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    made = []

    def subscribe(sink: ZeromqSink, *prefixes: bytes) -> zmq.Socket[bytes]:
        listener = context.socket(zmq.SUB)
        made.append(listener)
        for prefix in prefixes:
            listener.setsockopt(zmq.SUBSCRIBE, prefix)
        listener.connect(sink.addresses[0])
        return listener

    yield subscribe
    for listener in made:
        listener.close(linger=0)
    context.term()


def receive(sink: ZeromqSink, listener: zmq.Socket[bytes]) -> list[bytes]:
    """Wait for a message as the daemon would, polling the sink meanwhile."""
    give_up_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up_s:
        sink.poll()
        if listener.poll(5):
            return listener.recv_multipart()
    raise AssertionError("no message")


def poll_until_wanted(sink: ZeromqSink, wanted: set[str]) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while {topic for topic in TOPICS if sink.wants(topic)} != wanted:
        assert time.monotonic() < give_up_s
        sink.poll()
        time.sleep(0.005)


@pytest.fixture
def encoded(monkeypatch: pytest.MonkeyPatch) -> list[Event]:
    """Return a list that grows by each event the sink serialises."""
    events: list[Event] = []
    for name in ("encode", "encode_at"):
        original = getattr(zeromq, name)

        def counted(event: Event, *rest: object, original: Callable[..., bytes] = original) -> bytes:
            events.append(event)
            return original(event, *rest)

        monkeypatch.setattr(zeromq, name, counted)
    return events


def test_a_new_subscriber_at_once_gets_the_last_message_of_its_topics_only(
    sink: ZeromqSink, subscribe: Subscribe
) -> None:
    for event in (touch(1), touch(2), health(1), key(1)):
        sink.publish(event, 0)
    listener = subscribe(sink, b"touch")
    topic, payload = receive(sink, listener)
    assert (topic, json.loads(payload)["seq"]) == (b"touch", 2)
    sink.publish(touch(3), 0)
    assert json.loads(receive(sink, listener)[1])["seq"] == 3


def test_what_a_new_subscriber_gets_is_byte_for_byte_what_the_others_got(
    sink: ZeromqSink, subscribe: Subscribe
) -> None:
    first = subscribe(sink, b"touch")
    sink.wait_for_subscriber(PATIENCE_S)
    sink.publish(touch(1), 0)
    original = receive(sink, first)
    second = subscribe(sink, b"touch")
    assert receive(sink, second) == original
    assert receive(sink, first) == original  # XPUB cannot address the second alone


def test_a_message_nobody_was_there_for_stays_the_same_once_it_was_sent(sink: ZeromqSink, subscribe: Subscribe) -> None:
    sink.publish(touch(1), 0)
    original = receive(sink, subscribe(sink, b"touch"))
    assert receive(sink, subscribe(sink, b"touch")) == original
    assert json.loads(original[1])["latency_us"] == 0


def test_nothing_is_serialised_while_nobody_listens(sink: ZeromqSink, encoded: list[Event]) -> None:
    for seq in range(100):
        for event in (touch(seq), key(seq), health(seq), spectrum(seq)):
            sink.publish(event, 0)
        sink.poll()
    assert encoded == []


def test_only_what_somebody_listens_to_is_serialised_and_only_as_long(
    sink: ZeromqSink, subscribe: Subscribe, encoded: list[Event]
) -> None:
    listener = subscribe(sink, b"health")
    sink.wait_for_subscriber(PATIENCE_S, "health")
    sink.publish(touch(1), 0)
    sink.publish(health(1), 0)
    assert encoded == [health(1)]
    listener.close()
    poll_until_wanted(sink, set())
    sink.publish(health(2), 0)
    assert encoded == [health(1)]


@pytest.mark.parametrize(
    ("prefixes", "topics"),
    [
        ((b"",), set(TOPICS)),
        ((b"to",), {"touch"}),
        ((b"touch", b"key"), {"touch", "key"}),
        ((b"touchpad", b"\xff\x00", b"key"), {"key"}),
    ],
)
def test_a_subscription_wants_every_topic_that_begins_with_it(
    sink: ZeromqSink, subscribe: Subscribe, prefixes: tuple[bytes, ...], topics: set[str]
) -> None:
    subscribe(sink, *prefixes)
    poll_until_wanted(sink, topics)


def test_a_client_that_subscribes_twice_leaves_nothing_behind(sink: ZeromqSink, subscribe: Subscribe) -> None:
    listener = subscribe(sink, b"touch", b"touch")
    poll_until_wanted(sink, {"touch"})
    listener.close()
    poll_until_wanted(sink, set())


def test_one_of_two_subscribers_leaving_takes_nothing_from_the_other(sink: ZeromqSink, subscribe: Subscribe) -> None:
    leaving, staying = subscribe(sink, b"touch"), subscribe(sink, b"touch")
    sink.publish(touch(1), 0)
    receive(sink, leaving)
    receive(sink, staying)
    leaving.setsockopt(zmq.UNSUBSCRIBE, b"touch")
    leaving.setsockopt(zmq.SUBSCRIBE, b"key")
    poll_until_wanted(sink, {"touch", "key"})
    sink.publish(touch(2), 0)
    while json.loads(receive(sink, staying)[1])["seq"] != 2:
        pass


def test_a_spectrum_is_made_no_longer_than_somebody_wants_it(sink: ZeromqSink, subscribe: Subscribe) -> None:
    listener = subscribe(sink, b"spectrum", b"touch")
    poll_until_wanted(sink, {"spectrum", "touch"})
    listener.setsockopt(zmq.UNSUBSCRIBE, b"spectrum")
    poll_until_wanted(sink, {"touch"})


def test_the_latency_is_read_when_the_message_is_ready(subscribe: Subscribe) -> None:
    sink = ZeromqSink(LOCAL, clock=lambda: 5_250_000)
    try:
        listener = subscribe(sink, b"touch")
        sink.wait_for_subscriber(PATIENCE_S)
        sink.publish(touch(1), received_ns=5_000_000)
        assert json.loads(receive(sink, listener)[1])["latency_us"] == 250.0
    finally:
        sink.close()


STUCK = """
import json, sys, zmq
socket = zmq.Context().socket(zmq.SUB)
socket.connect(sys.argv[1])
socket.setsockopt(zmq.SUBSCRIBE, b"touch")
sys.stdin.readline()
seen = []
while not seen or seen[-1] < 100_000:
    seen.append(json.loads(socket.recv_multipart()[1])["seq"])
print(json.dumps([len(seen), seen == sorted(set(seen)), seen[-1]]), flush=True)
"""


def memory_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_a_subscriber_that_never_reads_delays_nobody_costs_little_and_sees_its_loss_in_seq() -> None:
    sink = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",), high_water_mark=100))
    command = [sys.executable, "-c", STUCK, sink.addresses[0]]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as stuck:
        try:
            sink.wait_for_subscriber(PATIENCE_S)
            before_bytes = memory_bytes()
            for seq in range(100_000):  # 150 MB in all
                sink.publish(touch(seq, fingers=10), 0)
            assert memory_bytes() - before_bytes < 50e6

            assert stuck.stdin is not None
            assert stuck.stdout is not None
            stuck.stdin.write("now read\n")
            stuck.stdin.flush()
            for seq in itertools.count(100_000):
                sink.publish(touch(seq), 0)
                if stuck.poll() is not None:
                    break
                time.sleep(0.005)
            received, in_order, last_seq = json.loads(stuck.stdout.read())
            assert in_order
            assert received < last_seq  # a gap in seq
        finally:
            stuck.kill()
            sink.close()


def test_closing_sends_what_is_waiting(subscribe: Subscribe) -> None:
    sink = ZeromqSink(LOCAL)
    listener = subscribe(sink, b"touch")
    sink.wait_for_subscriber(PATIENCE_S)
    for seq in range(500):
        sink.publish(touch(seq), 0)
    sink.close()
    for seq in range(500):
        assert listener.poll(int(PATIENCE_S * 1000))
        assert json.loads(listener.recv_multipart()[1])["seq"] == seq


def test_a_closed_sink_does_nothing_more(sink: ZeromqSink) -> None:
    sink.close()
    sink.close()
    sink.poll()
    sink.publish(touch(1), 0)
    assert not sink.wants("touch")


def test_waiting_for_a_subscriber_ends_with_an_explanation(sink: ZeromqSink) -> None:
    with pytest.raises(BusTimeout, match=r"127\.0\.0\.1.*'touch'.*start the subscriber"):
        sink.wait_for_subscriber(0.02)


def test_no_key_press_reaches_a_log(sink: ZeromqSink, subscribe: Subscribe, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    listener = subscribe(sink, b"")
    sink.wait_for_subscriber(PATIENCE_S)
    sink.publish(key(1), 0)
    assert b"hush-7" in receive(sink, listener)[1]
    sink.close()
    assert "hush-7" not in caplog.text
