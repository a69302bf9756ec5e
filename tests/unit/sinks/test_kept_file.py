"""A socket file outlives whoever tidies up in its folder."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from touchd.errors import BusError
from touchd.sinks.kept_file import KeptSocketFile


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "run").mkdir()
    return tmp_path / "run" / "bus"


@pytest.fixture
def listening(path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()
        listening.setblocking(False)
        yield listening


def reaches(path: Path, listening: socket.socket) -> bool:
    with socket.socket(socket.AF_UNIX) as client:
        try:
            client.connect(str(path))
            listening.accept()[0].close()
        except OSError:
            return False
    return True


def test_removed(path: Path, listening: socket.socket) -> None:
    """The file comes back as often as it is removed, with its mode, and the log says so each time."""
    path.chmod(0o660)
    kept = KeptSocketFile(path, socket.SOCK_STREAM)
    with capture_logs() as logs:
        for _ in range(3):
            path.unlink()
            assert not reaches(path, listening)
            kept.look()
            kept.look()
            assert reaches(path, listening)
    assert path.stat().st_mode & 0o777 == 0o660
    assert [entry["event"] for entry in logs] == 3 * ["somebody has removed the socket's file: it is back"]


def test_taken(path: Path, listening: socket.socket) -> None:
    """A program that binds there by mistake is left alone while it lives, and its dead file gives way."""
    kept = KeptSocketFile(path, socket.SOCK_STREAM)
    path.unlink()
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.bind(str(path))
        stranger.listen()
        kept.look()
        assert not reaches(path, listening)
    kept.look()
    assert reaches(path, listening)
    path.unlink()
    path.write_text("precious")
    kept.look()
    assert path.read_text() == "precious"


def test_gone(path: Path, listening: socket.socket) -> None:
    """Without the folder nothing can come back: an error, once, says what to do."""
    kept = KeptSocketFile(path, socket.SOCK_STREAM)
    shutil.rmtree(path.parent)
    with pytest.raises(BusError, match=r"nobody can connect any more.*start touchd again"):
        kept.look()
    kept.look()
    assert not reaches(path, listening)


def test_closed(path: Path, listening: socket.socket) -> None:
    """What is closed leaves no name, and brings nothing back; nor does a crashed one's stop the next."""
    KeptSocketFile(path, socket.SOCK_STREAM)
    kept = KeptSocketFile(path, socket.SOCK_STREAM)
    kept.close()
    kept.close()
    assert os.listdir(path.parent) == []
    kept.look()
    assert os.listdir(path.parent) == []
    assert not reaches(path, listening)


@pytest.mark.usefixtures("listening")
def test_closed_after_it_was_taken(path: Path) -> None:
    """A file of another process stays."""
    kept = KeptSocketFile(path, socket.SOCK_STREAM)
    path.unlink()
    path.write_text("precious")
    kept.close()
    assert os.listdir(path.parent) == [path.name]
