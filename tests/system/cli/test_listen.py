"""`touchd listen` as a process whose output is read while it writes, and which is interrupted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.processes import PATIENCE_S, end, started
from touchd.event import Contact, TouchEvent
from touchd.sinks.zeromq import ZeromqSink


@contextmanager
def listening(sink: ZeromqSink, *options: str) -> Iterator[subprocess.Popen[str]]:
    """A process that has subscribed to touches."""
    with started("listen", sink.addresses[0], *options) as process:
        sink.wait_for_subscriber(PATIENCE_S)
        yield process


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


def publish(sink: ZeromqSink, seq: int) -> None:
    contact = Contact(4, "move", 12.34, 56.78, 0.5, 1.5, 0.99, 0.0, 0.0)
    sink.publish(TouchEvent("plate", seq, seq, "2025-01-01T12:34:56.789000Z", seq, [contact]), 0)


def test_lines_at_once(sink: ZeromqSink) -> None:
    """Each line is out before the next event."""
    with listening(sink, "--json", "--count", "2") as process:
        publish(sink, 1)
        assert json.loads(line(process))["seq"] == 1
        publish(sink, 2)
        assert end(process).code == 0


def test_ctrl_c(sink: ZeromqSink) -> None:
    """Ctrl-C is an ordinary end."""
    with listening(sink) as process:
        publish(sink, 1)
        line(process)
        process.send_signal(signal.SIGINT)
        assert end(process) == (0, "", "")


def test_reader_leaves(sink: ZeromqSink) -> None:
    """A reader that has had enough is an ordinary end."""
    with listening(sink) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        publish(sink, 1)
        line(process)
        out = process.stdout.fileno()
        os.close(out)
        publish(sink, 2)
        publish(sink, 3)
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr.read() == ""
        os.dup2(os.open(os.devnull, os.O_RDONLY), out)  # so that it can be closed


def test_nothing_comes(tmp_path: Path) -> None:
    """Of a daemon that is not there, or does not know the key, one line on the standard error says what to check."""
    with started("listen", f"ipc://{tmp_path}/bus") as process:
        assert process.stderr is not None
        said = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        assert end(process) == (0, "", "")
    assert "no 'touch' or 'health' message" in said
    assert said.endswith("whether it asks for keys; still listening\n")
