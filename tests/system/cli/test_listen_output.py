"""`touchd listen`, as a person and as a script use it."""

from __future__ import annotations

import json
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime

import pytest
from click.testing import CliRunner

from tests.command_line import touchd
from tests.processes import PATIENCE_S
from touchd.cli.listen import command
from touchd.errors import BusTimeout
from touchd.event import Contact, Event, HealthEvent, KeyEvent, Latency, Phase, SpectrumEvent, State, TouchEvent
from touchd.sinks.zeromq import ZeromqSink

WALL = "2025-01-01T12:34:56.789000Z"


def touch(seq: int, phase: Phase = "move") -> TouchEvent:
    contacts = [Contact(4, phase, 12.34, 56.78, 0.5, 1.5, 0.99, 0.0, 0.0), Contact(3, "hold", 1, 2, 0.5, 1, 1, 0, 0)]
    return TouchEvent("plate", seq, seq, WALL, seq, contacts)


def health(seq: int, state: State = "streaming") -> HealthEvent:
    return HealthEvent("plate", seq, seq, WALL, state, 9, 0, 0, {"quiet": 4}, 5, Latency(), 1.0, 0.1, "m", "0.1.0")


class Listen:
    """`touchd listen` in a thread, which has subscribed."""

    def __init__(self, sink: ZeromqSink, *options: str, topic: str = "touch") -> None:
        self._pool = ThreadPoolExecutor(1)
        self._ended = self._pool.submit(touchd, "listen", sink.addresses[0], *options)
        sink.wait_for_subscriber(PATIENCE_S, topic)

    def end(self) -> tuple[int, str, str]:
        """Wait for its end, and return exit code, what it printed, and its complaints."""
        with self._pool:
            return self._ended.result(PATIENCE_S)


def publish(sink: ZeromqSink, *events: Event) -> None:
    for event in events:
        sink.publish(event, 0)


def test_person(sink: ZeromqSink) -> None:
    """A person sees a line for each change and none for a finger that rests."""
    listen = Listen(sink, "--count", "3")
    publish(sink, touch(1, "down"), touch(2, "hold"), touch(3, "up"))
    code, out, err = listen.end()
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        f"12:34:56.789 {phase} #4      12.34   56.78 mm  force 0.50  sigma 1.50 mm  confidence 0.99"
        for phase in ("down", "up  ")
    ]


def test_size(sink: ZeromqSink) -> None:
    """A person sees the size of a contact as far as it is told."""
    listen = Listen(sink, "--count", "1")
    sized = Contact(4, "move", 12.34, 56.78, 0.5, 1.5, 0.99, 0.0, 0.0, area_mm2=81.25, major_mm=11.6, angle_deg=-30.04)
    publish(sink, TouchEvent("plate", 1, 1, WALL, 1, [sized]))
    _, out, _ = listen.end()
    assert out.strip().endswith("confidence 0.99  area 81.2 mm2  long 11.6 mm  at -30.0 deg")


def test_json(sink: ZeromqSink) -> None:
    """A script gets the events as lines of JSON."""
    listen = Listen(sink, "--json", "--count", "2")
    publish(sink, touch(1), touch(2))
    code, out, err = listen.end()
    assert (code, err) == (0, "")
    assert [json.loads(line)["seq"] for line in out.splitlines()] == [1, 2]


def test_topics(sink: ZeromqSink) -> None:
    """Every topic can be read."""
    listen = Listen(
        sink, "--topic", "key", "--topic", "health", "--topic", "spectrum", "--count", "3", topic="spectrum"
    )
    for topic in ("key", "health"):
        sink.wait_for_subscriber(PATIENCE_S, topic)
    publish(
        sink, KeyEvent("plate", 1, 1, "?", "7", "press", 0.9), health(1), SpectrumEvent("p", 1, 1, WALL, 8, [2, -3])
    )
    code, out, _ = listen.end()
    assert code == 0
    assert out.splitlines() == [
        "? press   7  confidence 0.90",
        "12:34:56.789 streaming 9 frames, 5 inferred, 4 skipped, 0 lost, 0 corrupt  until sent p99 0 us  noise 1.00",
        "12:34:56.789 frame 8  2 features  largest 3.0",
    ]


def test_reason(sink: ZeromqSink) -> None:
    """A person sees why the device is lost."""
    listen = Listen(sink, "--topic", "health", "--count", "1", topic="health")
    event = health(1, "lost")
    event.reason = "the DAQ was unplugged"
    publish(sink, event)
    assert listen.end()[1].endswith("  reason: the DAQ was unplugged\n")


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_no_escapes(sink: ZeromqSink, options: tuple[str, ...]) -> None:
    """Nothing that a message holds can steer the terminal."""
    listen = Listen(sink, "--topic", "key", "--count", "1", *options, topic="key")
    publish(sink, KeyEvent("plate\x9b2J", 1, 1, "\x1b[2J", "7\x1b]0;mine\x07\x9b2J\u202e", "press", 0.9))
    _, out, _ = listen.end()
    assert out.rstrip("\n").isprintable()
    assert "mine" in out


def test_until_stopped(sink: ZeromqSink) -> None:
    """`--until-stopped` ends with the daemon and loses none of its touches."""
    listen = Listen(sink, "--json", "--until-stopped", topic="health")
    sink.wait_for_subscriber(PATIENCE_S, "touch")
    publish(sink, health(1), touch(1), touch(2), health(2, "stopping"))
    code, out, err = listen.end()
    assert (code, err) == (0, "")
    assert [json.loads(line)["type"] for line in out.splitlines()] == ["touch", "touch"]


def test_lost(sink: ZeromqSink) -> None:
    """Lost messages are reported at the end."""
    listen = Listen(sink, "--count", "2")
    publish(sink, touch(1), touch(5))
    code, _, err = listen.end()
    assert code == 0
    assert err.startswith("3 messages lost")


def test_everything(sink: ZeromqSink) -> None:
    """However old a message is, it is printed."""
    listen = Listen(sink, "--json", "--count", "2")
    now_ns = time.monotonic_ns()
    wall = datetime.now(UTC).isoformat()
    publish(sink, TouchEvent("plate", 1, now_ns, wall, 1, []), TouchEvent("plate", 2, now_ns - 10**10, wall, 2, []))
    assert len(listen.end()[1].splitlines()) == 2


def test_silence(sink: ZeromqSink) -> None:
    """Silence is a timeout."""
    with pytest.raises(BusTimeout):
        CliRunner().invoke(command, [sink.addresses[0], "--timeout", "0.02"], catch_exceptions=False)


def test_unknown_topic() -> None:
    """A topic that does not exist is wrong use."""
    result = CliRunner().invoke(command, ["--topic", "tuoch"])
    assert result.exit_code == 2
    assert "'touch', 'key', 'health', 'spectrum'" in result.output
