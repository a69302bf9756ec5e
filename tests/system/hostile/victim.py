"""A daemon as a process, and what can be seen of it from outside: memory, descriptors, files, log, messages."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.processes import PATIENCE_S, command, environment
from tests.system.hostile.usage import memory_kb, open_files
from touchd.cli.demo import SESSION
from touchd.client import Subscriber
from touchd.errors import BusTimeout
from touchd.event import Event, HealthEvent, TouchEvent

REPLAY = ("--replay", SESSION, "--loop", "--speed", "8")


@dataclass(frozen=True)
class Footprint:
    """What a process holds."""

    memory_kb: int
    descriptors: int
    threads: int


class Victim:
    """A daemon that replays a recording without end, and a subscriber that keeps what it publishes.

    Parameters
    ----------
    folder : Path
        Holds configuration, sockets, log and pre-roll.
    options : object
        Of the command line, beside configuration, bus and source.
    popen : object
        Of `subprocess.Popen`.
    """

    def __init__(self, folder: Path, *options: object, **popen: Any) -> None:
        self.folder, self.bus = folder, f"ipc://{folder}/bus"
        self.config, self.log, self.rolls = folder / "touchd.toml", folder / "log", folder / "rolls"
        self.events: list[Event] = []
        if not self.config.exists():
            self.configure("")
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                command("--config", self.config, "--bind", self.bus, *REPLAY, *options),
                **{"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, **popen}, stderr=log, env=environment(),
            )  # fmt: skip
        self._stop = threading.Event()
        self._listener = threading.Thread(target=self._listen)
        self._listener.start()

    def configure(self, text: str) -> None:
        """Replace the configuration, at once as a careful editor does."""
        new = self.folder / "new.toml"
        new.write_text(f'[preroll]\nfolder = "{self.rolls}"\nkeep = 3\n[control]\nsocket = "{self.folder}/c"\n{text}')
        new.replace(self.config)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to a daemon that must be alive."""
        assert self.process.poll() is None, self.log.read_text()[-2000:]
        self.process.send_signal(number)

    def lines(self, event: str) -> list[dict[str, Any]]:
        """Return the entries of the log about an event."""
        lines = [json.loads(line) for line in self.log.read_text().splitlines() if line.endswith("}")]
        return [line for line in lines if line["event"] == event]

    def footprint(self) -> Footprint:
        """Return what the process holds now."""
        number = self.process.pid
        return Footprint(memory_kb(number), open_files(number), len(os.listdir(f"/proc/{number}/task")))

    def wait(self, done: Callable[[], object], what: str) -> None:
        """Wait until something is done."""
        until_s = time.monotonic() + PATIENCE_S
        while not done():
            assert self.process.poll() is None, f"the daemon ended: {self.log.read_text()[-2000:]}"
            assert time.monotonic() < until_s, f"{what}: {self.log.read_text()[-2000:]}"
            time.sleep(0.02)

    def wait_for_frames(self, count: int = 200) -> None:
        """Wait until the daemon has published that many frames more, and a touch among them."""
        begin = len(self.events)
        health = [event.frames for event in self.events if isinstance(event, HealthEvent)]
        first = max(health, default=0)

        def done() -> bool:
            news = self.events[begin:]
            frames = [event.frames for event in news if isinstance(event, HealthEvent)]
            return max(frames, default=0) >= first + count and any(isinstance(event, TouchEvent) for event in news)

        self.wait(done, "no frames came")

    def phases(self) -> dict[int, list[str]]:
        """Return the phases of each contact, each once, in order."""
        story: dict[int, list[str]] = {}
        for event in self.events:
            for contact in event.contacts if isinstance(event, TouchEvent) else ():
                phases = story.setdefault(contact.id, [])
                if not phases or phases[-1] != contact.phase:
                    phases.append(contact.phase)
        return story

    def close(self) -> None:
        """End what is still running."""
        self._stop.set()
        self.process.kill()
        self.process.wait()
        self._listener.join()

    def _listen(self) -> None:
        with Subscriber(self.bus, ("touch", "health"), max_age_s=None) as events:
            while not self._stop.is_set():
                with suppress(BusTimeout):
                    self.events.append(events.receive(0.1))


@contextmanager
def victim(folder: Path, *options: object, **popen: Any) -> Iterator[Victim]:
    """Run a daemon that has begun to publish; it always ends with the test."""
    daemon = Victim(folder, *options, **popen)
    try:
        daemon.wait_for_frames(1)
        yield daemon
    finally:
        daemon.close()
