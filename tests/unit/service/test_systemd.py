"""The reports to the service manager, over a real socket."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest

from touchd.service.systemd import Notifier


class Manager:
    """The manager's end of the socket."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.socket.setblocking(False)

    def heard(self) -> list[str]:
        """Everything since the last call, a datagram an item."""
        messages = []
        with suppress(BlockingIOError):
            while True:
                messages.append(self.socket.recv(4096).decode())
        return messages


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(f"@touchd-test-{os.getpid()}" if request.param == "abstract" else str(tmp_path / "notify"))
    yield manager
    manager.socket.close()


def test_it_says_ready_once_however_often_the_device_comes_back(manager: Manager) -> None:
    notifier = Notifier(manager.address)
    notifier.ready()
    notifier.ready()
    assert manager.heard() == ["READY=1"]
    notifier.close()


def test_the_status_is_one_line_and_sent_when_it_changes(manager: Manager) -> None:
    notifier = Notifier(manager.address)
    for text in ("waiting", "waiting", "two\nlines\tof text", "waiting"):
        notifier.status(text)
    assert manager.heard() == ["STATUS=waiting", "STATUS=two lines of text", "STATUS=waiting"]
    notifier.close()


def test_a_reload_is_framed_by_its_time_and_a_new_ready(manager: Manager) -> None:
    notifier = Notifier(manager.address, clock=lambda: 1_234_567_890_123)
    notifier.ready()
    notifier.reloading()
    notifier.reloaded()
    assert manager.heard() == ["READY=1", "RELOADING=1\nMONOTONIC_USEC=1234567890", "READY=1"]
    notifier.close()


def test_a_reload_before_it_is_ready_does_not_say_that_it_is(manager: Manager) -> None:
    notifier = Notifier(manager.address)
    notifier.reloading()
    notifier.reloaded()
    assert manager.heard() == []
    notifier.close()


def test_the_watchdog_is_fed_four_times_in_its_interval_and_no_oftener(manager: Manager) -> None:
    notifier = Notifier(manager.address, watchdog_s=2.0)
    beats_ns = []
    for now_ns in range(0, 10_000_000_000, 8_000_000):
        notifier.beat(now_ns)
        beats_ns += [now_ns for message in manager.heard() if message == "WATCHDOG=1"]
    # A frame comes every 8 ms, so a heartbeat is up to 8 ms later than half a second after the one before.
    gaps_ns = {after - before for before, after in pairwise(beats_ns)}
    assert beats_ns[0] == 0
    assert gaps_ns == {504_000_000}
    notifier.close()


def test_a_ready_that_was_not_heard_is_said_again(manager: Manager) -> None:
    notifier = Notifier(manager.address)
    for number in range(1000):  # more than a socket holds
        notifier.status(f"line {number}")
    notifier.ready()
    assert "READY=1" not in manager.heard()
    notifier.ready()
    notifier.ready()
    assert manager.heard() == ["READY=1"]
    notifier.close()


def test_without_a_watchdog_there_are_no_heartbeats(manager: Manager) -> None:
    notifier = Notifier(manager.address)
    notifier.beat(0)
    notifier.beat(10**12)
    assert manager.heard() == []
    notifier.close()


def test_the_environment_of_systemd_is_understood(manager: Manager) -> None:
    environment = {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}
    notifier = Notifier.from_environment(environment)
    assert notifier.watchdog_s == 3.0
    notifier.stopping()
    assert manager.heard() == ["STOPPING=1"]
    notifier.close()
    for_another = Notifier.from_environment(environment | {"WATCHDOG_PID": "1"})
    assert for_another.watchdog_s == 0.0
    for_another.close()


def test_no_manager_a_manager_that_went_and_one_that_does_not_listen_stop_nobody(tmp_path: Path) -> None:
    for notifier in (Notifier.from_environment({}), Notifier(str(tmp_path / "nobody"), watchdog_s=1.0)):
        notifier.ready()
        notifier.beat(0)
        notifier.close()
        notifier.close()
    manager = Manager(str(tmp_path / "full"))
    notifier = Notifier(manager.address)
    for number in range(5000):  # far more than a socket holds: it is not waited for
        notifier.status(f"line {number}")
    assert 0 < len(manager.heard()) < 5000
    manager.socket.close()
    notifier.status("the manager has gone")
    notifier.close()
