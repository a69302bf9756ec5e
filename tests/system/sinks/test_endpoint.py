"""Where the bus may be bound, and who may use it there."""

from __future__ import annotations

import contextlib
import grp
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from touchd import files
from touchd.client import Subscriber
from touchd.config.schema import BusSettings
from touchd.errors import AddressInUse, BusError, BusTimeout, InsecureBind
from touchd.event import KeyEvent
from touchd.sinks import endpoint
from touchd.sinks.zeromq import ZeromqSink

PUBLISHER = """
import sys, time
from touchd.config.schema import BusSettings
from touchd.event import KeyEvent
from touchd.sinks.zeromq import ZeromqSink
sink = ZeromqSink(BusSettings(bind=(sys.argv[1],)))
print(*sink.addresses, flush=True)
sink.publish(KeyEvent("other", 1, 0, "", "7", "press", 1.0), 0)
while True:
    sink.poll()
    time.sleep(0.005)
"""


class Other:
    """Another process that publishes."""

    def __init__(self, address: str) -> None:
        command = [sys.executable, "-c", PUBLISHER, address]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip()

    def kill(self) -> None:
        """Stop it as a power cut would: nothing is tidied up."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def other(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Other]:
    other = Other(request.param.format(tmp_path))
    yield other
    other.kill()


def bind(*addresses: str, **settings: object) -> tuple[str, ...]:
    """Bind a sink, close it, and return its addresses."""
    sink = ZeromqSink(BusSettings.model_validate({"bind": addresses, **settings}))
    sink.close()
    return sink.addresses


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize(
    "address",
    ["tcp://*:*", "tcp://0.0.0.0:*", "tcp://[::]:*", "tcp://eth0:5570", "tcp://lo:*", "tcp://192.0.2.1:5570",
     "tcp://127.0.0.1.example.org:5570", "ipc://@touchd"],
)  # fmt: skip
def test_an_address_that_others_can_reach_is_refused_without_keys(address: str) -> None:
    with pytest.raises(InsecureBind, match="insecure = true") as refused:
        bind("tcp://127.0.0.1:*", address)
    assert refused.value.where == address


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:*", "tcp://127.9.9.9:*", "tcp://localhost:*", "tcp://[::1]:*"])
def test_loopback_needs_no_keys(address: str) -> None:
    if "::" in address and not Path("/proc/net/if_inet6").exists():
        pytest.skip("no IPv6 here")
    assert bind(address)[0].startswith("tcp://")


def test_an_open_address_can_be_allowed() -> None:
    assert bind("tcp://0.0.0.0:*", insecure=True)[0].startswith("tcp://0.0.0.0:")


@pytest.mark.parametrize("other", ["tcp://127.0.0.1:*", "ipc://{}/bus"], indirect=True)
def test_an_address_of_another_publisher_is_refused_and_left_working(other: Other) -> None:
    with pytest.raises(AddressInUse, match=r"stop it.*or set another") as refused:
        bind(other.address)
    assert refused.value.where == other.address
    with Subscriber(other.address, topics=("key",), timeout_s=60) as events:
        assert next(events).device == "other"


@pytest.mark.parametrize("other", ["ipc://{}/bus"], indirect=True)
def test_the_socket_file_of_a_killed_publisher_is_replaced(other: Other) -> None:
    other.kill()
    path = Path(other.address.removeprefix("ipc://"))
    assert path.is_socket()
    sink = ZeromqSink(BusSettings(bind=(other.address,)))
    try:
        with Subscriber(other.address, topics=("key",)):
            sink.wait_for_subscriber(60, "key")
    finally:
        sink.close()


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:{0}", "ipc://{1}/bus"])
def test_the_same_address_twice_is_refused(address: str, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = address.format(port, tmp_path)
    with pytest.raises(AddressInUse):
        bind(address, address)
    assert bind(address) == (address,)  # and what was bound is free again


def test_several_addresses_are_all_served(tmp_path: Path) -> None:
    addresses = ("tcp://127.0.0.1:*", f"ipc://{tmp_path}/bus", "tcp://127.0.0.1:*")
    sink = ZeromqSink(BusSettings(bind=addresses))
    try:
        assert len(set(sink.addresses)) == 3
        sink.publish(KeyEvent("here", 1, 0, "", "1", "press", 1.0), 0)
        with contextlib.ExitStack() as stack:
            waiting = [stack.enter_context(Subscriber(address, topics=("key",))) for address in sink.addresses]
            give_up_s = time.monotonic() + 60
            while waiting:
                assert time.monotonic() < give_up_s
                sink.poll()
                with contextlib.suppress(BusTimeout):
                    assert waiting[0].receive(0.01).device == "here"
                    del waiting[0]
    finally:
        sink.close()


def test_anything_but_a_socket_is_never_replaced(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("precious")
    with pytest.raises(BusError, match="something else than a socket"):
        bind(f"ipc://{path}")
    assert path.read_text() == "precious"


@pytest.mark.parametrize(
    ("address", "problem"),
    [
        ("ipc://{}/nowhere/bus", "cannot publish there"),
        ("ipc://{}/" + 120 * "x", "at most 107 bytes"),
        ("ipc://*", "needs a path"),
        ("tcp://127.0.0.1", "not an address"),
        ("tcp://127.0.0.1:99999", "not an address"),
        ("tcp://:5570", "not an address"),
    ],
)
def test_an_unusable_address_is_explained(address: str, problem: str, tmp_path: Path) -> None:
    address = address.format(tmp_path)
    with pytest.raises(BusError, match=problem) as refused:
        bind(address)
    assert refused.value.where == address
    assert refused.value.fix


def test_a_socket_file_is_private_even_under_a_lax_umask(tmp_path: Path) -> None:
    umask = os.umask(0)
    try:
        sink = ZeromqSink(BusSettings(bind=(f"ipc://{tmp_path}/bus",)))
        assert mode(tmp_path / "bus") == 0o600
        sink.close()
    finally:
        assert os.umask(umask) == 0  # the process has its own umask back


def test_a_group_gets_in_and_at_no_moment_anybody_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # root can give a file to any group, others to one of theirs.
    group = grp.getgrgid(1 if os.getuid() == 0 else os.getgid())
    modes = []
    chown = os.chown

    def watched(path: Path, uid: int, gid: int) -> None:
        modes.append(mode(path))
        chown(path, uid, gid)

    monkeypatch.setattr("touchd.sinks.endpoint.os.chown", watched)
    sink = ZeromqSink(BusSettings(bind=(f"ipc://{tmp_path}/bus",), ipc_group=group.gr_name))
    try:
        assert modes == [0o600]
        assert mode(tmp_path / "bus") == 0o660
        assert (tmp_path / "bus").stat().st_gid == group.gr_gid
    finally:
        sink.close()


@pytest.mark.parametrize("other", ["ipc://{}/bus"], indirect=True)
def test_a_removed_socket_file(other: Other) -> None:
    """A script that removes the bus's file cuts nobody off: it comes back, for who comes later, too."""
    path = Path(other.address.removeprefix("ipc://"))
    with Subscriber(other.address, topics=("key",), timeout_s=60) as before:
        assert next(before).device == "other"
        path.unlink()
        with Subscriber(other.address, topics=("key",), timeout_s=60) as later:
            assert next(later).device == "other"
    assert path.is_socket()


def test_closed_bus(tmp_path: Path) -> None:
    """A daemon that ends leaves no socket file, which would look like a daemon that runs."""
    sink = ZeromqSink(BusSettings(bind=(f"ipc://{tmp_path}/bus",)))
    assert (tmp_path / "bus").is_socket()
    sink.close()
    assert list(tmp_path.iterdir()) == []


def test_without_its_folder(tmp_path: Path) -> None:
    """A bus that nobody can find any more ends the daemon: systemd starts it again, with a new folder."""
    (tmp_path / "run").mkdir()
    sink = ZeromqSink(BusSettings(bind=(f"ipc://{tmp_path}/run/bus",)))
    try:
        shutil.rmtree(tmp_path / "run")
        with pytest.raises(BusError, match="start touchd again"):
            sink.wait_for_subscriber(60)
    finally:
        sink.close()


def test_an_unknown_group_is_named(tmp_path: Path) -> None:
    with pytest.raises(BusError, match=r"no group 'no-such-group'.*groupadd"):
        bind(f"ipc://{tmp_path}/bus", ipc_group="no-such-group")
    assert not (tmp_path / "bus").exists()


def test_two_that_start_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second looks once the first listens, and is refused: it would take the file from it."""
    address, looked, refused = f"ipc://{tmp_path}/bus", threading.Event(), threading.Event()
    really = files.clear_socket

    def second() -> None:
        with contextlib.suppress(AddressInUse), endpoint.private_file(address, ""):
            return
        refused.set()

    def look(*arguments: Any) -> None:
        looked.set()
        really(*arguments)

    with socket.socket(socket.AF_UNIX) as first:
        with endpoint.private_file(address, ""):
            monkeypatch.setattr(files, "clear_socket", look)
            thread = threading.Thread(target=second)
            thread.start()
            assert not looked.wait(0.1)
            first.bind(str(tmp_path / "bus"))
            first.listen()
        thread.join()
    assert looked.is_set()
    assert refused.is_set()
