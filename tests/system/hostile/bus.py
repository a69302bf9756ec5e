"""A daemon that replays, an honest subscriber, and strangers that attack its bus."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from tests.processes import PATIENCE_S, ROOT, command, environment
from touchd.cli.demo import SESSION
from touchd.client import Subscriber
from touchd.errors import BusTimeout
from touchd.event import TouchEvent

DESCRIPTORS = 1024


def free_address() -> str:
    """A port of loopback that nobody uses."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{free.getsockname()[1]}"


class Daemon:
    """A daemon in a process of its own, which replays the demo session for ever."""

    def __init__(
        self, folder: Path, address: str, *, descriptors: int = DESCRIPTORS, speed: float = 1.0, **settings: str
    ) -> None:
        self.folder, self.address = folder, address
        self.log = folder / "log"
        self.config = folder / "touchd.toml"
        self.config.touch()
        settings |= {"TOUCHD_PREROLL__FOLDER": str(folder / "preroll"), "TOUCHD_LOG__FORMAT": "json"}
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                ["prlimit", f"--nofile={descriptors}:{descriptors}", *command(
                    "--config", self.config, "--replay", SESSION, "--loop", "--speed", speed, "--bind", address)],
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, cwd=ROOT, env=environment(**settings),
            )  # fmt: skip

    def said(self, text: str) -> list[str]:
        """Lines of the log with a text."""
        return [line for line in self.log.read_text().splitlines() if text in line]

    def wait(self, text: str) -> None:
        """Wait for a line of the log."""
        give_up_s = time.monotonic() + PATIENCE_S
        while not self.said(text):
            assert time.monotonic() < give_up_s, f"{text!r} was not logged: {self.log.read_text()}"
            time.sleep(0.05)

    def end(self) -> float:
        """Stop the daemon as its manager would, and return how long that took, s."""
        began_s = time.monotonic()
        self.process.terminate()
        assert self.process.wait(PATIENCE_S) == 0
        return time.monotonic() - began_s


class Honest:
    """A subscriber that reads, in a thread, and remembers how old touches were."""

    def __init__(self, address: str, server_key: Path | None = None, client_key: Path | None = None) -> None:
        self._events = Subscriber(address, server_key=server_key, client_key_file=client_key, max_age_s=None)
        self.ages_s: list[float] = []
        self._ending = False
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while not self._ending:
            try:
                event = self._events.receive(0.2)
            except BusTimeout:
                continue
            assert isinstance(event, TouchEvent)
            self.ages_s.append((time.monotonic_ns() - event.t_ns) * 1e-9)

    def hears_more(self, number: int = 10) -> bool:
        """Whether further touches come."""
        before, give_up_s = len(self.ages_s), time.monotonic() + PATIENCE_S
        while len(self.ages_s) < before + number:
            if time.monotonic() > give_up_s:
                return False
            time.sleep(0.02)
        return True

    def close(self) -> None:
        self._ending = True
        self._thread.join()
        self._events.close()


@contextmanager
def attack(daemon: Daemon, name: str, number: int, strangers: int = 1) -> Iterator[None]:
    """Have strangers do their worst; they keep their connections until the end."""
    script = Path(__file__).parent / "stranger.py"
    with ExitStack() as stack:
        line: list[str] = [sys.executable, str(script), name, daemon.address, str(number)]
        attackers = [
            stack.enter_context(subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
            for _ in range(strangers)
        ]
        try:
            for attacker in attackers:
                assert attacker.stdout is not None
                while attacker.stdout.readline().strip() not in ("done", ""):
                    pass
            yield
        finally:
            for attacker in attackers:
                attacker.kill()
