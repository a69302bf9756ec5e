"""The daemon as a process under a service manager: readiness, life, reload, and a quick end, over a real socket."""

from __future__ import annotations

import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S, ROOT, command, environment
from touchd.cli.demo import SESSION
from touchd.client import Subscriber
from touchd.event import TouchEvent

WATCHDOG_S = 1.0


class Managed:
    """A daemon, and the socket on which it tells its manager of itself."""

    def __init__(self, folder: Path, *options: object) -> None:
        self.bus = f"ipc://{folder}/bus"
        self.config = folder / "touchd.toml"
        self.config.touch()
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(folder / "notify"))
        self.log = folder / "log"
        manager = {"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": str(round(WATCHDOG_S * 1e6))}
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                command("--config", self.config, "--bind", self.bus, *options),
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, env=environment(**manager),
            )  # fmt: skip

    def hear(self, timeout_s: float = PATIENCE_S) -> str | None:
        """The next thing it says, or None if it says nothing in time."""
        self.socket.settimeout(timeout_s)
        try:
            return self.socket.recv(4096).decode()
        except TimeoutError:
            return None

    def hear_until(self, start: str) -> list[str]:
        """What it says up to something that begins like this, which must come."""
        heard: list[str] = []
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            heard.append(self.hear(PATIENCE_S) or "")
            if heard[-1].startswith(start):
                return heard
        pytest.fail(f"{start!r} was not said; the log: {self.log.read_text()}")


@contextmanager
def managed(folder: Path, *options: object) -> Iterator[Managed]:
    daemon = Managed(folder, *options)
    try:
        yield daemon
    finally:
        daemon.process.kill()
        daemon.process.communicate()
        daemon.socket.close()


def test_ready(tmp_path: Path) -> None:
    """It is ready with the first frame and not before."""
    with managed(tmp_path, "--replay", SESSION, "--await-subscriber", PATIENCE_S) as daemon:
        # Started, its address bound, and no frame yet: it waits for a subscriber.
        while not (tmp_path / "bus").exists():
            time.sleep(0.01)
        assert daemon.hear(0.3) is None
        with Subscriber(daemon.bus, timeout_s=PATIENCE_S):
            heard = daemon.hear_until("READY=1")
        assert heard == [f"STATUS={state}: 0 frames, 0 lost, 0 corrupt" for state in ("starting", "streaming")] + [
            "READY=1"
        ]


def test_awaiting_device(tmp_path: Path) -> None:
    """It is ready while it awaits its device, and stays alive."""
    daq = "[device]\nvendor_id = 0xfffe\nproduct_id = 0xfffe\n"  # not to be found on the computer of the test
    (tmp_path / "touchd.toml").write_text(daq)
    with managed(tmp_path) as daemon:
        heard = daemon.hear_until("READY=1")
        assert heard[-2].startswith("STATUS=lost: ")
        assert "fffe:fffe" in heard[-2]
        for _ in range(5):
            daemon.hear_until("WATCHDOG=1")
        daemon.process.terminate()
        daemon.hear_until("STOPPING=1")
        assert daemon.process.wait(PATIENCE_S) == 0


def test_watchdog(tmp_path: Path) -> None:
    """A pipeline that hangs starves the watchdog although its threads live."""
    # Nobody reads what it prints: once the pipe is full the sink hangs, while ZeroMQ's thread goes on.
    with managed(tmp_path, "--replay", SESSION, "--loop", "--speed", "20", "--print") as daemon:
        daemon.hear_until("WATCHDOG=1")
        heard: list[str | None] = []
        while (said := daemon.hear(WATCHDOG_S)) is not None:
            heard.append(said)
            assert len(heard) < 1000, "it does not hang"
        assert len(os.listdir(f"/proc/{daemon.process.pid}/task")) > 1
        daemon.process.send_signal(signal.SIGABRT)  # as the manager does
        assert daemon.process.wait(PATIENCE_S) == -signal.SIGABRT
        assert "in publish" in daemon.log.read_text(), "the log tells where it hung"


def test_sighup(tmp_path: Path) -> None:
    """SIGHUP takes over thresholds, and a wrong file changes nothing."""
    with managed(tmp_path, "--replay", SESSION, "--loop") as daemon:
        daemon.hear_until("READY=1")
        daemon.config.write_text("[tracker]\ndead_band_mm = 3.0\n[device]\nrate_hz = 100\n")
        daemon.process.send_signal(signal.SIGHUP)
        assert daemon.hear_until("RELOADING=1")[-1].partition("MONOTONIC_USEC=")[2].isdecimal()
        daemon.hear_until("READY=1")
        daemon.config.write_text("[tracker]\ndead_band_mm = -3.0\n")
        daemon.process.send_signal(signal.SIGHUP)
        daemon.hear_until("RELOADING=1")
        daemon.hear_until("READY=1")
        daemon.hear_until("WATCHDOG=1")
        assert daemon.process.poll() is None
    log = daemon.log.read_text()
    assert '"taken": ["tracker.dead_band_mm"]' in log
    assert '"waiting": ["device.rate_hz"]' in log
    assert "tracker.dead_band_mm: is -3.0, must be" in log


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGUSR1])
def test_signals_while_starting(tmp_path: Path, number: signal.Signals) -> None:
    """A signal that comes while the daemon starts waits for it."""
    (tmp_path / "touchd.toml").write_text(f"[preroll]\nfolder = '{tmp_path / 'rolls'}'\n")
    with managed(tmp_path, "--replay", SESSION, "--loop") as daemon:
        status = Path(f"/proc/{daemon.process.pid}/status")
        held, deadline = False, time.monotonic() + PATIENCE_S
        while not held and time.monotonic() < deadline:
            assert daemon.process.poll() is None
            held = bool(int(re.findall(r"SigBlk:\s*(\w+)", status.read_text())[0], 16) & 1 << number - 1)
        daemon.process.send_signal(number)
        daemon.hear_until("READY=1")
        done = "configuration read again" if number == signal.SIGHUP else "pre-roll saved"
        while done not in daemon.log.read_text() and time.monotonic() < deadline:
            daemon.hear_until("WATCHDOG=1")
        assert daemon.process.poll() is None
    assert done in daemon.log.read_text()


AT_ONCE = """
import importlib.abc, os, sys

class Impatient(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "click":
            os.kill(os.getpid(), NUMBER)

sys.meta_path.insert(0, Impatient())
from touchd.__main__ import run
run()
"""


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGUSR1])
def test_signals_before_the_imports(tmp_path: Path, number: signal.Signals) -> None:
    """A signal that comes before the command line is known waits for the daemon, and ends a verb."""
    code, folder = AT_ONCE.replace("NUMBER", str(int(number))), {"TOUCHD_PREROLL__FOLDER": str(tmp_path / "rolls")}
    daemon = ("--replay", SESSION, "--speed", "max", "--bind", f"ipc://{tmp_path}/bus")
    ends = [
        subprocess.run(
            [sys.executable, "-c", code, *map(str, arguments)],
            capture_output=True, cwd=ROOT, env=environment(**folder), timeout=PATIENCE_S, check=False,
        ).returncode
        for arguments in (daemon, ("config",))
    ]  # fmt: skip
    assert ends == [0, -number]


def test_preroll_off(tmp_path: Path) -> None:
    """A reload with `preroll.seconds = 0` ends the pre-roll: SIGUSR1 then writes nothing and ends nothing."""
    folder = f"[preroll]\nfolder = '{tmp_path / 'rolls'}'\n"
    (tmp_path / "touchd.toml").write_text(folder)
    with managed(tmp_path, "--replay", SESSION, "--loop") as daemon:
        daemon.hear_until("READY=1")
        daemon.config.write_text(folder + "seconds = 0\n")
        daemon.process.send_signal(signal.SIGHUP)
        daemon.hear_until("RELOADING=1")
        daemon.hear_until("READY=1")
        daemon.process.send_signal(signal.SIGUSR1)
        daemon.hear_until("WATCHDOG=1")
        daemon.hear_until("WATCHDOG=1")
        assert daemon.process.poll() is None
    assert "preroll.seconds is 0" in daemon.log.read_text()
    assert not (tmp_path / "rolls").exists()


def test_file_limit(tmp_path: Path) -> None:
    """The daemon may open as many files as the system allows at most."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (200, before[1]))
    try:
        with managed(tmp_path, "--replay", SESSION, "--loop") as daemon:
            daemon.hear_until("READY=1")
            assert resource.prlimit(daemon.process.pid, resource.RLIMIT_NOFILE) == (before[1], before[1])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_sigterm(tmp_path: Path) -> None:
    """SIGTERM during a touch lifts it and ends the daemon within a second: at one of five times, if others compute."""
    for attempt in range(5):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        took_s = seconds_to_stop(folder)
        if took_s < 1.0:
            return
    pytest.fail(f"it took {took_s:.1f} s")


def seconds_to_stop(folder: Path) -> float:
    with managed(folder, "--replay", SESSION, "--loop") as daemon:
        with Subscriber(daemon.bus, timeout_s=PATIENCE_S, max_age_s=None) as events:
            next(event for event in events if isinstance(event, TouchEvent))
            started_s = time.monotonic()
            daemon.process.terminate()
            phases = [c.phase for event in events_until_up(events) for c in event.contacts]
            assert daemon.process.wait(PATIENCE_S) == 0
            took_s = time.monotonic() - started_s
        assert phases[-1] == "up"
        daemon.hear_until("STOPPING=1")
    return took_s


def events_until_up(events: Subscriber[TouchEvent]) -> list[TouchEvent]:
    heard: list[TouchEvent] = []
    for event in events:
        if isinstance(event, TouchEvent):
            heard.append(event)
            if event.contacts[0].phase == "up":
                break
    return heard
