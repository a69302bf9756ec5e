"""A bus whose messages the test makes, and the bridge in a process of its own, with a model of the kernel behind it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

import zmq

from tests.processes import PATIENCE_S, ROOT, environment
from tests.unit.bridges.events import contact, health, touch
from tests.unit.bridges.kernel import EVENT, Kernel
from touchd.bridges import uinput
from touchd.event import Contact, State, encode

SCREEN = {"TOUCHD_INPUT__SCREEN_MM": "0,0,200,100"}
_SYN = EVENT.pack(0, 0, uinput.EV_SYN, uinput.SYN_REPORT, 0)


class Daemon:
    """Publishes messages as a daemon would, with the times of now."""

    def __init__(self, folder: Path) -> None:
        self.address = f"ipc://{folder}/bus"
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._seq = {"touch": count(1), "health": count(1)}
        self.start()

    def start(self) -> None:
        self._socket = self._context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDHWM, 0)
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # each subscriber is heard of
        self._socket.bind(self.address)

    def wait(self) -> None:
        """Return when a bridge has subscribed to touches."""
        while True:
            assert self._socket.poll(int(PATIENCE_S * 1000))
            if self._socket.recv() == b"\1touch":
                return

    def touch(self, *contacts: Contact) -> int:
        """Publish a touch message and return its time."""
        event = touch(*contacts, t_ns=time.monotonic_ns(), seq=next(self._seq["touch"]))
        event.wall = wall()
        self._socket.send_multipart([b"touch", encode(event)])
        return event.t_ns

    def health(self, state: State) -> None:
        event = health(state, seq=next(self._seq["health"]), t_ns=time.monotonic_ns())
        event.wall = wall()
        self._socket.send_multipart([b"health", encode(event)])

    def kill(self) -> None:
        """The daemon is gone, without a word."""
        self._socket.close()

    def close(self) -> None:
        self._socket.close()
        self._context.term()


def wall() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


class Bridge:
    """`touchd input` in a process of its own."""

    def __init__(self, folder: Path, address: str, **variables: str) -> None:
        self.pipe = folder / "uinput"
        if not self.pipe.exists():
            os.mkfifo(self.pipe)
        self.reader = os.open(self.pipe, os.O_RDONLY | os.O_NONBLOCK)
        os.set_blocking(self.reader, False)
        self.kernel = Kernel()
        self.arrived_ns: list[int] = []
        self._rest = b""
        arguments = [sys.executable, "-m", "tests.system.bridges.fakeuinput", str(self.pipe), "input", "--bus", address]
        self.process = subprocess.Popen(
            arguments, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=environment(**SCREEN, **variables)
        )

    def pump(self) -> None:
        """Hand the kernel what the bridge wrote meanwhile."""
        try:
            data = os.read(self.reader, 1 << 16)
        except BlockingIOError:
            return
        self._rest += data
        begin = 0
        for end in range(EVENT.size, len(self._rest) + 1, EVENT.size):
            if self._rest[end - EVENT.size : end] == _SYN:
                self.arrived_ns.append(time.monotonic_ns())
                self.kernel.write(self._rest[begin:end])
                begin = end
        self._rest = self._rest[begin:]

    def until(self, done: Callable[[], object], meanwhile: Callable[[], object] = lambda: None) -> None:
        """Return once something holds; `meanwhile` is called about every 20 ms."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline_s
            meanwhile()
            time.sleep(0.02)
            self.pump()

    def close(self) -> str:
        """End it; the kernel removes what a process that ended had open. Return what it said."""
        if self.process.poll() is None:
            self.process.kill()
        _, said = self.process.communicate(timeout=PATIENCE_S)
        self.pump()
        os.close(self.reader)
        return said


@contextmanager
def daemon(folder: Path) -> Iterator[Daemon]:
    one = Daemon(folder)
    try:
        yield one
    finally:
        one.close()


@contextmanager
def bridge(folder: Path, on: Daemon, **variables: str) -> Iterator[Bridge]:
    """A bridge that listens already."""
    one = Bridge(folder, on.address, **variables)
    try:
        on.wait()
        yield one
    finally:
        one.close()


def down(id: int = 1, x_mm: float = 50.0, y_mm: float = 60.0) -> Contact:  # noqa: A002 - the field's name
    return contact(id, "down", x_mm, y_mm)
