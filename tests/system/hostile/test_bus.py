"""Strangers on the bus of a running daemon: it stays small, quick and open to honest subscribers."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S
from tests.system.hostile.bus import DESCRIPTORS, Daemon, Honest, attack, free_address
from tests.system.hostile.usage import memory_kb, open_files
from touchd.client import Subscriber
from touchd.sinks import curve

MOST_GROWTH_KB = 20_000
SPEED = 4.0
"""Of the replay: each step waits for tens of touches."""


@contextmanager
def bounded(daemon: Daemon, honest: Honest, what: str, descriptors: int = 100) -> Iterator[None]:
    """Hold that the daemon stays small and goes on publishing, and print what it came to."""
    assert honest.hears_more(30)
    process = daemon.process.pid
    before = most = memory_kb(process)
    files = most_files = open_files(process)
    quiet = max(honest.ages_s[5:])
    honest.ages_s.clear()
    ended = threading.Event()

    def watch() -> None:
        nonlocal most, most_files
        while not ended.wait(0.02):
            most, most_files = max(most, memory_kb(process)), max(most_files, open_files(process))

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
        assert honest.hears_more()
    finally:
        ended.set()
        watcher.join()
    give_up_s = time.monotonic() + PATIENCE_S
    while open_files(process) > files + descriptors and time.monotonic() < give_up_s:
        time.sleep(0.1)
    after, files_after = memory_kb(process), open_files(process)
    cut = sum(1 + int(json.loads(line).get("unlogged", 0)) for line in daemon.said('"subscriber '))
    print(
        f"{what}: memory {before} -> {most} (peak) -> {after} kB, open files {files} -> {most_files} (peak) -> "
        f"{files_after}; cut off or refused {cut}; oldest of {len(honest.ages_s)} touches "
        f"{max(honest.ages_s) * 1e3:.0f} ms, {quiet * 1e3:.0f} ms before"
    )
    assert most - before <= MOST_GROWTH_KB
    assert files_after <= files + descriptors


@pytest.fixture
def full(request: pytest.FixtureRequest) -> bool:
    """Whether there is time."""
    return bool(request.config.getoption("--hostile") == "full")


@contextmanager
def replaying(folder: Path, address: str = "") -> Iterator[Daemon]:
    daemon = Daemon(folder, address or f"ipc://{folder}/bus", speed=SPEED)
    try:
        yield daemon
    finally:
        daemon.process.kill()
        daemon.process.wait()


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon for several attacks, one after the other: none may leave anything behind."""
    with replaying(tmp_path_factory.mktemp("lasting")) as daemon:
        yield daemon


@pytest.fixture
def daemon(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Daemon]:
    """A daemon that publishes at a file; or, if a test asks for one, at a port, or the lasting one."""
    how = getattr(request, "param", "")
    if how == "lasting":
        yield request.getfixturevalue("lasting")
        return
    with replaying(tmp_path, free_address() if how == "tcp" else "") as daemon:
        yield daemon


@pytest.fixture
def honest(daemon: Daemon) -> Iterator[Honest]:
    honest = Honest(daemon.address)
    assert honest.hears_more(1), daemon.log.read_text()
    yield honest
    honest.close()


@pytest.mark.parametrize(
    ("name", "number", "many", "strangers"),
    [
        ("long-topics", 2_000, 10_700, 4),
        ("small-topics", 50_000, 670_000, 1),
        ("tiny-topics", 10_000, 10_000, 4),
        ("messages", 50_000, 1_000_000, 1),
    ],
)
def test_topics(daemon: Daemon, honest: Honest, full: bool, name: str, number: int, many: int, strangers: int) -> None:
    """Who subscribes to thousands of topics is cut off before they cost memory."""
    with bounded(daemon, honest, name, 0), attack(daemon, name, many if full else number, strangers):
        daemon.wait('"subscriber ')
    assert daemon.end() < PATIENCE_S / 2


@pytest.mark.parametrize("daemon", ["ipc", "tcp"], indirect=True)
def test_connections(daemon: Daemon, honest: Honest) -> None:
    """More connections than descriptors keep no subscriber out, nor reload and pre-roll from working."""
    with bounded(daemon, honest, "idle connections"), attack(daemon, "idle", DESCRIPTORS + 100):
        newcomer = Honest(daemon.address)
        try:
            assert newcomer.hears_more(1)
        finally:
            newcomer.close()
        daemon.config.write_text("[tracker]\ndead_band_mm = 0.2\n")
        daemon.process.send_signal(signal.SIGHUP)
        daemon.wait("tracker.dead_band_mm")
        daemon.process.send_signal(signal.SIGUSR1)
        give_up_s = time.monotonic() + PATIENCE_S
        while not list((daemon.folder / "preroll").glob("*.npz")):
            assert time.monotonic() < give_up_s, daemon.log.read_text()
            time.sleep(0.05)
    assert daemon.said("there are more than 64")


@pytest.mark.parametrize("daemon", ["lasting"], indirect=True)
def test_silent_subscribers(daemon: Daemon, honest: Honest, full: bool) -> None:
    """Subscribers that never read cost little, and are cut off."""
    with bounded(daemon, honest, "silent subscribers"), attack(daemon, "silent", 60):
        if full:
            daemon.wait("has read nothing")


@pytest.mark.parametrize("daemon", ["lasting"], indirect=True)
def test_reconnects(daemon: Daemon, honest: Honest, full: bool) -> None:
    """Thousands of connections, one after the other, leave nothing behind."""
    number = 4000 if full else 300
    with bounded(daemon, honest, f"{number} reconnects", 5), attack(daemon, "reconnects", number):
        pass


@pytest.mark.parametrize("daemon", ["lasting"], indirect=True)
def test_pings(daemon: Daemon, honest: Honest, full: bool) -> None:
    """Endless pings keep no touch back."""
    with bounded(daemon, honest, "pings"), attack(daemon, "pings", 300_000 if full else 20_000):
        pass


def test_keys(tmp_path: Path, full: bool) -> None:
    """With keys, too, want of descriptors and broken key files keep no known client out, nor the daemon from ending."""
    for name in ("server", "friend", "stranger"):
        curve.make_files(tmp_path / "keys", name)
    clients = tmp_path / "clients"
    clients.mkdir()
    shutil.copy(tmp_path / "keys/friend.key", clients)
    address = free_address()
    daemon = Daemon(
        tmp_path, address, descriptors=256, speed=SPEED,
        TOUCHD_BUS__CURVE_SECRET_KEY=str(tmp_path / "keys/server.key_secret"), TOUCHD_BUS__CURVE_CLIENTS=str(clients),
    )  # fmt: skip
    server_key = tmp_path / "keys/server.key"
    friend = server_key, tmp_path / "keys/friend.key_secret"
    try:
        honest = Honest(address, *friend)
        try:
            os.mkfifo(clients / "x.key")
            (clients / "y.key").write_text("damaged")
            (clients / "z.key").mkdir()
            with (
                bounded(daemon, honest, "keys"),
                attack(daemon, "idle", 1100 if full else 240),
                Subscriber(address, server_key=server_key, client_key_file=tmp_path / "keys/stranger.key_secret"),
            ):
                daemon.wait("its key is unknown")
                for _ in range(20 if full else 3):
                    newcomer = Honest(address, *friend)
                    try:
                        assert newcomer.hears_more(1)
                    finally:
                        newcomer.close()
                assert all(daemon.said(name) for name in ("x.key", "y.key", "z.key"))
            with attack(daemon, "idle", 240):
                assert daemon.end() < PATIENCE_S / 2
        finally:
            honest.close()
    finally:
        daemon.process.kill()
        daemon.process.wait()
