"""`touchd listen`, as a person and as a script use it."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import TextIO

import pytest
from click.testing import CliRunner

from touchd.cli.listen import command
from touchd.config.schema import BusSettings
from touchd.errors import BusTimeout
from touchd.event import Contact, Event, HealthEvent, KeyEvent, Latency, Phase, SpectrumEvent, State, TouchEvent
from touchd.sinks.zeromq import ZeromqSink

WALL = "2025-01-01T12:34:56.789000Z"


def touch(seq: int, phase: Phase = "move") -> TouchEvent:
    contacts = [Contact(4, phase, 12.34, 56.78, 0.5, 1.5, 0.99, 0.0, 0.0), Contact(3, "hold", 1, 2, 0.5, 1, 1, 0, 0)]
    return TouchEvent("plate", seq, seq, WALL, seq, contacts)


def health(seq: int, state: State = "streaming") -> HealthEvent:
    return HealthEvent("plate", seq, seq, WALL, state, 9, 0, 0, {"quiet": 4}, 5, Latency(), 1.0, 0.1, "m", "0.1.0")


@pytest.fixture
def sink() -> Iterator[ZeromqSink]:
    sink = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)))
    yield sink
    sink.close()


class Listen:
    """`touchd listen` in a process of its own."""

    def __init__(self, sink: ZeromqSink, *options: str, topic: str = "touch") -> None:
        call = "from touchd.cli.listen import command; command()"
        self.process = subprocess.Popen(
            [sys.executable, "-c", call, sink.addresses[0], *options],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        sink.wait_for_subscriber(60, topic)

    @property
    def stdout(self) -> TextIO:
        assert isinstance(self.process.stdout, io.TextIOWrapper)
        return self.process.stdout

    def end(self) -> tuple[int, str, str]:
        """Wait for its end, and return exit code, what else it printed, and its complaints."""
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err


def publish(sink: ZeromqSink, *events: Event) -> None:
    for event in events:
        sink.publish(event, 0)


def test_a_person_sees_a_line_for_each_change_and_none_for_a_finger_that_rests(sink: ZeromqSink) -> None:
    listen = Listen(sink, "--count", "3")
    publish(sink, touch(1, "down"), touch(2, "hold"), touch(3, "up"))
    code, out, err = listen.end()
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        f"12:34:56.789 {phase} #4      12.34   56.78 mm  force 0.50  sigma 1.50 mm  confidence 0.99"
        for phase in ("down", "up  ")
    ]


def test_a_script_gets_the_events_as_lines_of_json(sink: ZeromqSink) -> None:
    listen = Listen(sink, "--json", "--count", "2")
    publish(sink, touch(1), touch(2))
    code, out, err = listen.end()
    assert (code, err) == (0, "")
    assert [json.loads(line)["seq"] for line in out.splitlines()] == [1, 2]


def test_each_line_is_out_before_the_next_event(sink: ZeromqSink) -> None:
    listen = Listen(sink, "--json", "--count", "2")
    publish(sink, touch(1))
    assert json.loads(listen.stdout.readline())["seq"] == 1
    publish(sink, touch(2))
    assert listen.end()[0] == 0


def test_every_topic_can_be_read(sink: ZeromqSink) -> None:
    listen = Listen(
        sink, "--topic", "key", "--topic", "health", "--topic", "spectrum", "--count", "3", topic="spectrum"
    )
    for topic in ("key", "health"):
        sink.wait_for_subscriber(60, topic)
    publish(
        sink, KeyEvent("plate", 1, 1, "?", "7", "press", 0.9), health(1), SpectrumEvent("p", 1, 1, WALL, 8, [2, -3])
    )
    code, out, _ = listen.end()
    assert code == 0
    assert out.splitlines() == [
        "? press   7  confidence 0.90",
        "12:34:56.789 streaming 9 frames, 5 inferred, 4 skipped, 0 lost, 0 corrupt  latency p99 0 us  noise 1.00",
        "12:34:56.789 frame 8  2 features  largest 3.0",
    ]


def test_until_stopped_ends_with_the_daemon_and_loses_none_of_its_touches(sink: ZeromqSink) -> None:
    listen = Listen(sink, "--json", "--until-stopped", topic="health")
    sink.wait_for_subscriber(60, "touch")
    publish(sink, health(1), touch(1), touch(2), health(2, "stopping"))
    code, out, err = listen.end()
    assert (code, err) == (0, "")
    assert [json.loads(line)["type"] for line in out.splitlines()] == ["touch", "touch"]


def test_lost_messages_are_reported_at_the_end(sink: ZeromqSink) -> None:
    listen = Listen(sink, "--count", "2")
    publish(sink, touch(1), touch(5))
    code, _, err = listen.end()
    assert code == 0
    assert err.startswith("3 messages lost")


def test_ctrl_c_is_an_ordinary_end(sink: ZeromqSink) -> None:
    listen = Listen(sink)
    publish(sink, touch(1))
    listen.stdout.readline()
    listen.process.send_signal(signal.SIGINT)
    assert listen.end() == (0, "", "")


def test_a_reader_that_has_had_enough_is_an_ordinary_end(sink: ZeromqSink) -> None:
    listen = Listen(sink)
    publish(sink, touch(1))
    listen.stdout.readline()
    os.close(listen.stdout.fileno())
    publish(sink, touch(2), touch(3))
    assert listen.process.wait(60) == 0
    assert listen.process.stderr is not None
    assert listen.process.stderr.read() == ""
    listen.process.stderr.close()
    os.dup2(os.open(os.devnull, os.O_RDONLY), listen.stdout.fileno())  # so that it can be closed
    listen.stdout.close()


def test_silence_is_a_timeout(sink: ZeromqSink) -> None:
    with pytest.raises(BusTimeout):
        CliRunner().invoke(command, [sink.addresses[0], "--timeout", "0.02"], catch_exceptions=False)


def test_a_topic_that_does_not_exist_is_an_error_of_use() -> None:
    result = CliRunner().invoke(command, ["--topic", "tuoch"])
    assert result.exit_code == 2
    assert "'touch', 'key', 'health', 'spectrum'" in result.output
