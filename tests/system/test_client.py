"""What a Python program that listens can rely on."""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
import zmq
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from touchd import client
from touchd.client import Subscriber
from touchd.config.schema import BusSettings
from touchd.errors import BusError, BusTimeout
from touchd.event import Contact, Event, HealthEvent, KeyEvent, Latency, Phase, TouchEvent, encode
from touchd.sinks import stream
from touchd.sinks.zeromq import ZeromqSink


def touch(seq: int, t_ns: int = 0, device: str = "plate") -> TouchEvent:
    contact = Contact(1, "move", 12.5, 50.0, 0.5, 1.5, 0.99, 0.0, 0.0)
    return TouchEvent(device, seq, t_ns, "2025-01-01T00:00:00.000000Z", seq, [contact])


class Wire:
    """A publisher of given messages."""

    def __init__(self) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self.context.socket(zmq.XPUB)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind("tcp://127.0.0.1:*")
        self.address = self.socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def wait(self) -> None:
        """Return when somebody has subscribed."""
        assert self.socket.poll(60_000)
        self.socket.recv()

    def send(self, *events: Event) -> None:
        for event in events:
            self.socket.send_multipart([event.type.encode(), encode(event)])


@pytest.fixture(autouse=True)
def silence(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy computer stands still for longer than a daemon that lives."""
    monkeypatch.setattr(stream, "SILENCE_NS", 10**12)


@pytest.fixture
def wire() -> Iterator[Wire]:
    wire = Wire()
    yield wire
    wire.socket.close()
    wire.context.term()


def test_events_come_typed_and_in_order(wire: Wire) -> None:
    with Subscriber(wire.address, timeout_s=60) as events:
        wire.wait()
        wire.send(touch(1), touch(2), touch(3))
        for seq, event in zip((1, 2, 3), events, strict=False):
            assert event == touch(seq)
            for c in event.contacts:
                assert (c.id, c.phase, c.x_mm, c.y_mm) == (1, "move", 12.5, 50.0)
        assert events.lost.total() == 0


def test_a_repeated_message_is_dropped(wire: Wire) -> None:
    with Subscriber(wire.address, timeout_s=60) as events:
        wire.wait()
        wire.send(touch(1), touch(1), touch(1), touch(2), touch(2), touch(3))
        assert [next(events).seq for _ in range(3)] == [1, 2, 3]
        assert events.lost.total() == 0


def test_lost_messages_are_counted_by_topic(wire: Wire) -> None:
    with Subscriber(wire.address, topics=("",), timeout_s=60) as events:
        wire.wait()
        wire.send(touch(100), touch(101), KeyEvent("plate", 7, 0, "", "1", "press", 1.0), touch(105), touch(107))
        for _ in range(5):
            next(events)
        assert events.lost == {"touch": 4}  # 102, 103, 104 and 106; what was before the first is no loss


def test_plates_that_share_an_address_are_counted_apart(wire: Wire) -> None:
    with Subscriber(wire.address, timeout_s=60) as events:
        wire.wait()
        wire.send(
            touch(5, device="left"), touch(900, device="right"), touch(6, device="left"), touch(901, device="right")
        )
        assert [next(events).device for _ in range(4)] == ["left", "right", "left", "right"]
        assert events.lost.total() == 0


@pytest.mark.parametrize(
    ("before", "after"),
    [([500, 501], [1, 2, 3]), ([1], [1, 2]), ([2, 3], [3, 4])],
    ids=["counter falls", "same number at another time", "same number, not the first"],
)
def test_a_restarted_daemon_is_not_taken_for_repeats_or_loss(wire: Wire, before: list[int], after: list[int]) -> None:
    with Subscriber(wire.address, timeout_s=60) as events:
        wire.wait()
        wire.send(*(touch(seq, t_ns=seq) for seq in before), *(touch(seq, t_ns=10**12 + seq) for seq in after))
        assert [next(events).seq for _ in before + after] == before + after
        assert events.lost.total() == 0


def heard(sink: ZeromqSink, events: Subscriber[TouchEvent]) -> TouchEvent:
    """Return the next event, polling the sink meanwhile as the daemon does."""
    give_up_s = time.monotonic() + 60
    while time.monotonic() < give_up_s:
        sink.poll()
        try:
            return events.receive(0.01)
        except BusTimeout:
            pass
    raise AssertionError("no event")


def test_a_subscription_outlives_the_daemon_and_hears_its_successor() -> None:
    first = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)))
    with Subscriber(*first.addresses) as events:
        first.publish(touch(3, t_ns=1), 0)
        assert heard(first, events).seq == 3
        first.close()
        successor = ZeromqSink(BusSettings(bind=first.addresses))
        successor.publish(touch(1, t_ns=2), 0)
        assert heard(successor, events).seq == 1
        successor.close()


def test_a_second_subscriber_repeats_nothing_to_the_first() -> None:
    sink = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)))
    with Subscriber(*sink.addresses) as first, Subscriber(*sink.addresses) as second:
        sink.publish(touch(1), 0)
        for events in (first, second):
            assert heard(sink, events).seq == 1
        sink.publish(touch(2), 0)
        for events in (first, second):
            assert heard(sink, events).seq == 2
            assert events.lost.total() == 0
    sink.close()


def test_topics_and_keys_of_a_later_release_are_passed_over(wire: Wire) -> None:
    content = json.loads(encode(touch(1))) | {"mood": "sunny"}
    with Subscriber(wire.address, topics=("",), timeout_s=60) as events:
        wire.wait()
        wire.socket.send_multipart([b"weather", b"rain"])
        wire.socket.send_multipart([b"touchscreen", b"\xff"])
        wire.socket.send_multipart([b"touch", json.dumps(content).encode()])
        assert next(events) == touch(1)


PRESS = encode(KeyEvent("plate", 1, 0, "", "7", "press", 1.0))


@pytest.mark.parametrize(
    ("parts", "problem"),
    [
        ([b"touch", b"not json"], "not a touch message"),
        ([b"touch", b"\xff\xfe"], "not a touch message"),
        ([b"touch", b"[1]"], "not a touch message"),
        ([b"touch", encode(KeyEvent("plate", 1, 0, "", "hush-7", "press", 1.0))], "not a touch message"),
        ([b"key", b'{"v":1,"type":"key","key":["hush-7"]}'], "not a key message"),
        ([b"key", PRESS.replace(b"press", b"hush-7")], "phase: not as agreed"),
        ([b"key", b'{"v":1,"seq":"hush-7"}'], "seq: Expected `int`, got `str`"),
        (
            [b"touch", encode(touch(1)).replace(b'"device"', b'"dev"')],
            r"\(payload: Object missing required field `device`\)",
        ),
        ([b"touch"], "1 parts instead of 2"),
        ([b"touch", b"x", b"{}"], "3 parts instead of 2"),
        ([b"touch", encode(touch(1)).replace(b'"v":1', b'"v":2')], "of version 2.*upgrade"),
        ([b"touch", b'{"v":2}'], "of version 2.*upgrade"),
        ([b"touch", b'{"more":' + b"[" * 100_000 + b"]" * 100_000 + b"}"], "not a touch message"),
        ([b"touch", b'{"v":[2]}'], "not a touch message"),
        ([b"touch", encode(replace(touch(1), t_ns=-(10**40)))], "t_ns or seq: not as agreed"),
        ([b"touch", encode(replace(touch(1), seq=1 << 63))], "t_ns or seq: not as agreed"),
    ],
)
def test_a_malformed_message_is_explained_without_quoting_it(wire: Wire, parts: list[bytes], problem: str) -> None:
    with Subscriber(wire.address, topics=("touch", "key"), timeout_s=60) as events:
        wire.wait()
        wire.wait()
        wire.socket.send_multipart(parts)
        wire.send(touch(9))
        with pytest.raises(BusError, match=problem) as failed:
            next(events)
        assert failed.value.where == wire.address
        assert "hush-7" not in str(failed.value)
        assert failed.value.__cause__ is None  # msgspec's own error can quote what it was given
        assert next(events).seq == 9  # and the iteration can go on


PARTS = st.sampled_from([b"touch", b"key", b"touchscreen", b"{}", b"x", b"", encode(touch(2)), PRESS])


@settings(deadline=None, max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.lists(PARTS, min_size=1, max_size=4), min_size=1, max_size=8))
@example([[b"touch", encode(touch(2)), b"touchscreen"]])
def test_messages_of_any_parts(wire: Wire, messages: list[list[bytes]]) -> None:
    """A message of any parts but a topic and its event is refused, and costs no other message."""
    with Subscriber(wire.address, topics=("touch", "key"), timeout_s=60, max_age_s=None) as events:
        wire.wait()
        wire.wait()
        for number, parts in enumerate(messages):
            wire.socket.send_multipart(parts)
            wire.send(touch(100 + number, number))
        seen, refused = [0], 0
        while seen[-1] < 99 + len(messages):
            try:
                seen.append(next(events).seq)
            except BusError:
                refused += 1
    wire.wait()
    wire.wait()  # it is gone
    assert [seq for seq in seen if seq >= 100] == list(range(100, 100 + len(messages)))
    assert refused == sum(_is_wrong(parts) for parts in messages)


def _is_wrong(parts: list[bytes]) -> bool:
    """Whether a message is of a known topic, and not this and an event."""
    return parts[0] in (b"touch", b"key") and parts not in ([b"touch", encode(touch(2))], [b"key", PRESS])


def test_silence_ends_in_a_timeout_that_says_what_to_check(wire: Wire) -> None:
    with Subscriber(wire.address, timeout_s=0.02) as events:
        with pytest.raises(BusTimeout, match=r"no 'touch' message within 0\.02 s.*the daemon runs.*bus\.bind.*keys"):
            next(events)
        with pytest.raises(BusTimeout):
            events.receive(0)


def test_repeats_do_not_put_the_timeout_off(wire: Wire) -> None:
    with Subscriber(wire.address) as events:
        wire.wait()
        wire.send(touch(1))
        next(events)
        for _ in range(100):
            wire.send(touch(1))
        started_s = time.monotonic()
        with pytest.raises(BusTimeout):
            events.receive(0.05)
        assert time.monotonic() - started_s >= 0.05


def test_a_closed_subscription_ends_the_loop(wire: Wire) -> None:
    events = Subscriber(wire.address, timeout_s=60)
    wire.wait()
    wire.send(touch(1))
    for _ in events:
        events.close()
    events.close()


@pytest.mark.parametrize("timeout_s", [None, 60.0])
def test_closed_by_another_thread(wire: Wire, timeout_s: float | None) -> None:
    """The thread that waits for an event ends its loop, and `close` returns with the connection ended."""
    events = Subscriber(wire.address, timeout_s=timeout_s)
    wire.wait()
    seen: list[int] = []
    receiver = threading.Thread(target=lambda: seen.extend(event.seq for event in events))
    receiver.start()
    wire.send(touch(1))
    while not seen and receiver.is_alive():
        wire.send(touch(1))
    events.close()
    receiver.join(60)
    assert not receiver.is_alive()
    assert seen == [1]
    wire.wait()  # it is gone
    with pytest.raises(BusError, match="is closed -> make another Subscriber"):
        events.receive(0)


def test_closed_by_a_signal(wire: Wire) -> None:
    """The handler of a signal may end the subscription for which its own thread waits."""
    before = signal.signal(signal.SIGUSR2, lambda _number, _frame: events.close())
    try:
        with Subscriber(wire.address) as events:
            main = threading.get_ident()
            timer = threading.Timer(0.02, lambda: signal.pthread_kill(main, signal.SIGUSR2))
            timer.start()
            assert list(events) == []
            timer.join()
    finally:
        signal.signal(signal.SIGUSR2, before)


def test_a_flood_of_other_topics(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is passed over, however much of it comes, does not put a timeout off."""
    flood = iter([[b"touchscreen", b""]] * 1_000_000)
    with Subscriber(wire.address) as events:
        monkeypatch.setattr(events, "_received", lambda _timeout_s: next(flood))
        with pytest.raises(BusTimeout):
            events.receive(0.01)


@pytest.mark.parametrize(
    "address", ["", "127.0.0.1:5570", "tcp://127.0.0.1", "tcp://127.0.0.1:99999", "http://x:1", "ipc:///run/\udcff"]
)
def test_what_is_no_address_is_refused_at_once(address: str) -> None:
    with pytest.raises(BusError, match="write tcp://HOST:PORT"):
        Subscriber(address)


def test_a_misspelt_topic_is_refused_rather_than_waited_for() -> None:
    with pytest.raises(BusError, match=r"no topic 'tuoch'.*touch, key, health, spectrum"):
        Subscriber(topics=("tuoch",))
    with pytest.raises(BusError, match=r"no topic is asked for.*touch, key, health, spectrum"):
        Subscriber(topics=())
    with Subscriber(topics="touch") as events:
        assert events.topics == ("touch",)


def stamped(seq: int, age_s: float, phase: Phase = "move", device: str = "plate") -> TouchEvent:
    """A touch of a daemon on this computer."""
    t_ns = time.monotonic_ns() - round(age_s * 1e9)
    wall = datetime.fromtimestamp(time.time() - age_s, UTC).isoformat()
    return TouchEvent(device, seq, t_ns, wall, seq, [Contact(1, phase, 12.5, 50.0, 0.5, 1.5, 0.99, 0.0, 0.0)])


def test_stale_touches_are_dropped(wire: Wire) -> None:
    """After a standstill a program gets no touch older than half a second; the finger that was down is lifted."""
    with Subscriber(wire.address, timeout_s=60) as events:
        wire.wait()
        wire.send(stamped(1, 0, "down"))
        assert next(events).seq == 1
        wire.send(*(stamped(seq, 9 - seq / 100) for seq in range(2, 500)), stamped(500, 4, "up"))
        wire.send(stamped(501, 4, "down"), stamped(502, 3.9, "up"), stamped(503, 0, "down"))
        lifted, fresh = next(events), next(events)
        assert (lifted.seq, lifted.contacts) == (2, [])
        assert (fresh.seq, fresh.contacts[0].phase) == (503, "down")
        assert events.dropped == {"touch": 501}
        assert events.lost.total() == 0


@pytest.mark.parametrize("timeout_s", [0.0, 60.0])
def test_a_daemon_that_is_gone(wire: Wire, monkeypatch: pytest.MonkeyPatch, timeout_s: float) -> None:
    """Of a daemon that was killed with a finger down nothing comes any more: the finger is lifted, once."""
    with Subscriber(wire.address, timeout_s=60) as events:
        wire.wait()
        wire.send(stamped(1, 0, "down"))
        assert next(events).contacts
        monkeypatch.setattr(stream, "SILENCE_NS", 0)
        lifted = events.receive(timeout_s)
        assert (lifted.seq, lifted.contacts) == (1, [])
        with pytest.raises(BusTimeout):
            events.receive(0)


def pressed(touched: TouchEvent, phase: str = "press", key: str = "7") -> KeyEvent:
    return KeyEvent("plate", touched.seq, touched.t_ns, touched.wall, key, phase, 1.0)  # type: ignore[arg-type]  # the callers give phases


@pytest.mark.parametrize("newest_only", [False, True])
@pytest.mark.parametrize("topics", [("key",), ("key", "touch")])
def test_keys_of_a_daemon_that_is_gone(
    wire: Wire, monkeypatch: pytest.MonkeyPatch, topics: tuple[str, ...], newest_only: bool
) -> None:
    """A key is released once when its daemon falls silent, also for a program that asks for keys alone."""
    with Subscriber(wire.address, topics, timeout_s=60, newest_only=newest_only) as events:
        wire.wait()
        wire.wait()
        down = stamped(1, 0, "down")
        wire.send(down, pressed(down))
        first = next(event for event in events if isinstance(event, KeyEvent))
        assert (first.key, first.phase) == ("7", "press")
        with pytest.raises(BusTimeout):  # the finger rests
            events.receive(0)
        monkeypatch.setattr(stream, "SILENCE_NS", 0)
        release, *lifted = (next(events) for _ in topics)
        assert [event.type for event in lifted] == ["touch"] * (len(topics) - 1)
        assert isinstance(release, KeyEvent)
        assert (release.key, release.phase) == ("7", "release")
        with pytest.raises(BusTimeout):
            events.receive(0)


def test_all_keys_of_a_daemon_that_is_gone_are_released_at_once(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the releases of several keys and the event without contacts nothing is waited for."""
    with Subscriber(wire.address, ("key", "touch"), timeout_s=60) as events:
        wire.wait()
        wire.wait()
        down = stamped(1, 0, "down")
        wire.send(down, *(replace(pressed(down, key=str(key)), seq=key) for key in (1, 2, 3)))
        assert [next(events).type for _ in range(4)] == ["touch", "key", "key", "key"]
        waits_s, received = list[float](), events._received

        def receive(wait_s: float) -> list[bytes] | None:
            waits_s.append(wait_s)
            return received(wait_s)

        monkeypatch.setattr(events, "_received", receive)
        monkeypatch.setattr(stream, "SILENCE_NS", 0)
        released = [next(events) for _ in range(4)]
        assert [event.type for event in released] == ["key", "key", "key", "touch"]
        assert waits_s[1:] == [0.0] * (len(waits_s) - 1)


def test_a_program_that_asks_for_keys_alone_gets_keys_alone(wire: Wire) -> None:
    """The touches that tell it of the daemon's silence stay out."""
    with Subscriber(wire.address, ("key",), timeout_s=60) as events:
        wire.wait()
        wire.wait()
        for seq in range(1, 20, 2):
            wire.send(stamped(seq, 0, "down"), pressed(down := stamped(seq, 0)), stamped(seq + 1, 0, "up"))
            wire.send(pressed(down, "release"))
        assert [next(events).type for _ in range(10)] == ["key"] * 10


@pytest.mark.parametrize("max_age_s", [None, math.inf, 100.0])
def test_a_bridge_gets_everything(wire: Wire, max_age_s: float | None) -> None:
    """Without a largest age every message comes, in order."""
    with Subscriber(wire.address, timeout_s=60, max_age_s=max_age_s) as events:
        wire.wait()
        wire.send(*(stamped(seq, 10 - seq) for seq in range(1, 10)))
        assert [next(events).seq for _ in range(9)] == list(range(1, 10))


def test_health_is_never_stale(wire: Wire) -> None:
    """The state of a daemon that says nothing new is returned, however old the message is."""
    old = stamped(1, 100)
    health = HealthEvent("plate", 1, old.t_ns, old.wall, "lost", 1, 0, 0, {}, 0, Latency(), 1.0, 0.1, "m", "0")
    with Subscriber(wire.address, ("health",), timeout_s=60) as events:
        wire.wait()
        wire.send(health)
        assert next(events) == health


def test_newest_only(wire: Wire) -> None:
    """Who wants the newest alone gets it, and every key."""
    with Subscriber(wire.address, ("touch", "key"), timeout_s=60, newest_only=True, max_age_s=None) as events:
        wire.wait()
        wire.wait()
        wire.send(stamped(1, 0))
        assert next(events).seq == 1
        keys = [KeyEvent("plate", seq, 0, "", "7", "press", 1.0) for seq in (1, 2)]
        wire.send(stamped(2, 0), keys[0], stamped(3, 0), keys[1], stamped(4, 0))
        give_up_s = time.monotonic() + 60
        while not events._socket.poll(100):
            assert time.monotonic() < give_up_s
        time.sleep(0.2)  # until all have arrived
        assert [(event.type, event.seq) for event in (next(events) for _ in range(3))] == [
            ("key", 1), ("key", 2), ("touch", 4),
        ]  # fmt: skip
        assert events.dropped == {"touch": 2}


def test_devices_without_end(wire: Wire) -> None:
    """Names of devices without end cost no memory without end."""
    with Subscriber(wire.address, timeout_s=60) as events:
        wire.wait()
        for n in range(2000):
            wire.send(touch(1, device=f"plate {n}"))
            next(events)
        assert len(events._streams) <= 256


def test_a_huge_message(wire: Wire) -> None:
    """A message beyond all reason is not decoded."""
    with Subscriber(wire.address, timeout_s=60) as events:
        wire.wait()
        wire.socket.send_multipart([b"touch", b" " * (8 << 20)])
        wire.send(touch(2))
        with pytest.raises(BusError, match="8388608 bytes"):
            next(events)
        assert next(events).seq == 2


@pytest.mark.parametrize("timeout_s", [math.inf, 1e18])
def test_for_ever(wire: Wire, timeout_s: float) -> None:
    """To wait without end can be said as a number, too."""
    with Subscriber(wire.address, timeout_s=timeout_s) as events:
        wire.wait()
        wire.send(touch(1))
        assert next(events).seq == 1


def test_a_forked_process(wire: Wire) -> None:
    """A subscription does not go along into a process that is forked: that is told, not waited for."""
    with Subscriber(wire.address) as events:
        child = os.fork()
        if not child:
            try:
                events.receive(0.01)
            except BusError as error:
                os._exit(7 if "each process" in error.fix else 1)
            finally:
                os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        wire.wait()
        wire.send(touch(1))
        assert next(events).seq == 1


def made_with(free: int, make: Callable[[], object]) -> int:
    """What becomes of a process that may open so many more files: 0 if `make` succeeds there, 7 if it raises."""
    child = os.fork()
    if not child:
        try:
            limit = [number for number in range(1000) if not os.path.lexists(f"/proc/self/fd/{number}")][free]
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
            make()
            os._exit(0)
        except BusError as error:
            os._exit(7 if "ulimit -n" in error.fix else 1)
        finally:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.parametrize("make", [Subscriber, lambda: ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)))])
def test_no_file_can_be_opened(make: Callable[[], object]) -> None:
    """A program that may open no more files gets an error that says so: libzmq does not abort it."""
    for free in range(8):
        assert made_with(free, make) == 7, free
    assert made_with(40, make) == 0


def test_no_thread_can_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program whose user may have no more threads gets an error that says so: libzmq does not abort it."""

    def start(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(BusError, match=r"2 more threads are needed \(can't start new thread\) -> .*TasksMax="):
        Subscriber()


def test_nonsense(wire: Wire) -> None:
    """What is no time is refused."""
    with pytest.raises(BusError, match="age"):
        Subscriber(wire.address, max_age_s=math.nan)
    with Subscriber(wire.address) as events, pytest.raises(BusError, match="not a number"):
        events.receive(math.nan)


def test_the_default_is_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an address a program finds the service, and a daemon on loopback as well while there is no service."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        loopback = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    service = f"ipc://{tmp_path}/bus"
    monkeypatch.setattr(client, "SERVICE_ADDRESS", service)
    monkeypatch.setattr(client, "DEFAULT_ADDRESS", loopback)
    for address in (service, loopback):  # each comes up later than the program
        with Subscriber() as events:
            sink = ZeromqSink(BusSettings(bind=(address,)))
            sink.publish(touch(1), 0)
            assert heard(sink, events).seq == 1
            sink.close()
        (tmp_path / "bus").unlink(missing_ok=True)  # as systemd does with the folder
    sink = ZeromqSink(BusSettings(bind=(service,)))
    with Subscriber() as events:
        assert events.address == service
    sink.close()
