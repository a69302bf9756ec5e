"""The examples of docs/developer.md run as they stand in docs/examples."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

import pytest
from msgspec.structs import replace

from touchd.client import Subscriber
from touchd.config.schema import BusSettings
from touchd.errors import BusTimeout
from touchd.event import Contact, Event, TouchEvent, encode
from touchd.sinks.zeromq import ZeromqSink

DOCS = Path(__file__).resolve().parents[2] / "docs"
EXAMPLES = DOCS / "examples"
PATIENCE_S = 60.0


def missing(what: str) -> NoReturn:
    """Skip the test, except where everything has to be there."""
    if os.environ.get("CI") == "true":
        pytest.fail(f"{what} is missing")
    pytest.skip(f"{what} is missing")


def touch(seq: int) -> TouchEvent:
    contacts = [Contact(seq, "move", 10.0 * seq, 56.7, 0.5, 1.5, 0.99, 0.0, 0.0)]
    return TouchEvent("plate", seq, seq, "2025-01-01T00:00:00.000000Z", seq, contacts)


@pytest.fixture
def sink() -> Iterator[ZeromqSink]:
    # A constant clock, so that the C example's raw payload is known.
    sink = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)), clock=lambda: 0)
    yield sink
    sink.close()


def repeated(sink: ZeromqSink, another: Subscriber[Event]) -> Event:
    """Return what the bus sends once more for another subscriber's sake, once it has taken in its subscription."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        sink.poll()
        try:
            return another.receive(0.1)
        except BusTimeout:
            if time.monotonic() > deadline_s:
                raise


def check(sink: ZeromqSink, command: list[str], line_of: Callable[[TouchEvent], str]) -> None:
    """Run an example, and see that it prints each touch once: a repeat is no touch, a restarted daemon's is one."""
    with subprocess.Popen([*command, sink.addresses[0]], stdout=subprocess.PIPE, text=True) as example:
        guard = threading.Timer(PATIENCE_S, example.kill)
        guard.start()
        try:
            assert example.stdout is not None
            sink.wait_for_subscriber(PATIENCE_S)
            sink.publish(touch(1), 0)
            assert example.stdout.readline().strip() == line_of(touch(1))
            with Subscriber(sink.addresses[0], ("touch", "key")) as another:
                assert repeated(sink, another).seq == 1
            sink.publish(touch(2), 0)
            assert example.stdout.readline().strip() == line_of(touch(2))
            restarted = replace(touch(2), t_ns=99)  # another daemon's message, under the same number
            sink.publish(restarted, 0)
            assert example.stdout.readline().strip() == line_of(restarted)
        finally:
            guard.cancel()
            example.kill()


def contact_line(event: TouchEvent) -> str:
    (c,) = event.contacts
    return f"{c.id} {c.phase} {c.x_mm:.1f} {c.y_mm:.1f}"


def test_the_page_has_the_examples() -> None:
    """The page prints the one in Python word for word, and links the others."""
    page = (DOCS / "developer.md").read_text()
    assert (EXAMPLES / "listen.py").read_text() in re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    for name in ("listen.c", "listen.mjs"):
        assert f"(examples/{name})" in page


def test_the_python_example_runs(sink: ZeromqSink) -> None:
    check(sink, [sys.executable, str(EXAMPLES / "listen.py")], contact_line)


@pytest.mark.parametrize("how", ["Ctrl-C", "its reader leaves"])
def test_the_python_example_ends_quietly(how: str, sink: ZeromqSink) -> None:
    command = [sys.executable, str(EXAMPLES / "listen.py"), sink.addresses[0]]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as example:
        assert example.stdout is not None
        assert example.stderr is not None
        try:
            sink.wait_for_subscriber(PATIENCE_S)
            if how == "Ctrl-C":
                example.send_signal(signal.SIGINT)
            else:
                example.stdout.close()
                sink.publish(touch(1), 0)
            example.wait(PATIENCE_S)
        finally:
            example.kill()
        assert example.stderr.read() == ""


def test_the_c_example_compiles_without_a_warning_and_runs(sink: ZeromqSink, tmp_path: Path) -> None:
    if shutil.which("cc") is None:
        missing("a C compiler (package gcc)")
    if subprocess.run(["cc", "-E", "-include", "zmq.h", "-x", "c", "/dev/null"], capture_output=True).returncode != 0:
        missing("zmq.h (package libzmq3-dev)")
    program = str(tmp_path / "listen")
    flags = ["-std=c11", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run(["cc", *flags, "-o", program, str(EXAMPLES / "listen.c"), "-lzmq"], check=True)
    check(sink, [program], lambda event: encode(event).decode())


def test_the_node_example_runs(sink: ZeromqSink, tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        missing("Node.js (packages nodejs and npm)")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "touchd/node"
    modules = Path(os.environ.get("TOUCHD_NODE_DIR") or cache) / "node_modules"
    if not (modules / "zeromq").is_dir():
        missing("zeromq for Node.js (run docs/examples/install-node-zeromq.sh)")
    # A module's imports are looked for beside its own file.
    (tmp_path / "node_modules").symlink_to(modules)
    shutil.copy(EXAMPLES / "listen.mjs", tmp_path)
    check(sink, [node, str(tmp_path / "listen.mjs")], contact_line)
