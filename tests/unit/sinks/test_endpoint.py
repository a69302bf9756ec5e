"""Where the bus is bound that nobody told where, and whom its file is closed to."""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from touchd.client import Subscriber
from touchd.config.schema import BusSettings
from touchd.errors import BusError
from touchd.sinks.endpoint import effective, private_file


@pytest.mark.parametrize(
    ("folder", "address", "group"),
    [
        ("", "tcp://127.0.0.1:5570", ""),
        ("/run/touchd", "ipc:///run/touchd/bus", "touchd-bus"),
        ("/run/touchd:/run/other", "ipc:///run/touchd/bus", "touchd-bus"),
    ],
)
def test_default(monkeypatch: pytest.MonkeyPatch, folder: str, address: str, group: str) -> None:
    """The service binds a file of its runtime folder for its group, any other daemon loopback; settings come first."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", folder)
    found = effective(BusSettings())
    assert (found.bind, found.ipc_group) == ((address,), group)
    assert effective(BusSettings(ipc_group="kiosk")).ipc_group == "kiosk"
    told = BusSettings(bind=("ipc:///tmp/bus",))
    assert effective(told) == told


@contextmanager
def as_somebody() -> Iterator[None]:
    """Be a user for whom permissions hold."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


@pytest.mark.parametrize(("folder", "file"), [(0o000, 0o666), (0o755, 0o000)], ids=["folder", "file"])
def test_closed_to_this_user(folder: int, file: int) -> None:
    """Whom the socket or its folder is closed to learns it, and does not wait for ever."""
    with tempfile.TemporaryDirectory() as name, socket.socket(socket.AF_UNIX) as publisher:
        path = Path(name) / "bus"
        publisher.bind(str(path))
        path.chmod(file)
        path.parent.chmod(folder)
        with as_somebody(), pytest.raises(BusError, match="may not use the socket -> join the group"):
            Subscriber(f"ipc://{path}")
        path.parent.chmod(0o700)


def test_another_kind_of_socket(tmp_path: Path) -> None:
    """A socket of another kind, such as a control socket, is left to whoever listens there."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.bind(str(tmp_path / "control"))
        with (
            pytest.raises(BusError, match=r"wrong type.* -> set another bus.bind"),
            private_file(f"ipc://{tmp_path}/control", ""),
        ):
            pass
