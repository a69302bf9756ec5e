"""touchd in processes of its own, as its users run it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from touchd.client import Subscriber
    from touchd.event import Event

PATIENCE_S = 120.0
"""How long anything may take, on a computer that is busy with something else."""
ROOT = Path(__file__).resolve().parent.parent
Message = dict[str, Any]


class Ended(NamedTuple):
    """What is left of a process."""

    code: int
    out: str
    err: str

    @property
    def messages(self) -> list[Message]:
        """Its output as lines of JSON."""
        return [json.loads(line) for line in self.out.splitlines()]


def environment(**variables: str) -> dict[str, str]:
    """This process's environment with no setting of touchd but the given ones."""
    own = {name: value for name, value in os.environ.items() if not name.upper().startswith("TOUCHD_")}
    return own | {"OPENBLAS_NUM_THREADS": "1"} | variables


def command(*arguments: object, module: str = "touchd") -> list[str]:
    """The command line of touchd, or of a module that changes it."""
    return [sys.executable, "-m", module, *map(str, arguments)]


def touchd(*arguments: object, cwd: Path = ROOT, patience_s: float = PATIENCE_S, **variables: str) -> Ended:
    """Run touchd to its end."""
    done = subprocess.run(
        command(*arguments), capture_output=True, text=True, timeout=patience_s, cwd=cwd, env=environment(**variables)
    )
    return Ended(done.returncode, done.stdout, done.stderr)


@contextmanager
def started(*arguments: object, module: str = "touchd", **variables: str) -> Iterator[subprocess.Popen[str]]:
    """Run touchd beside the test; it always ends with the test."""
    process = subprocess.Popen(
        command(*arguments, module=module), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL, text=True, cwd=ROOT, env=environment(**variables),
    )  # fmt: skip
    with process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()


def end(process: subprocess.Popen[str]) -> Ended:
    """Wait for a process, and return what it said beyond what was read already."""
    out, err = process.communicate(timeout=PATIENCE_S)
    return Ended(process.returncode, out, err)


def through_the_bus(folder: Path, recording: Path, *options: object, **variables: str) -> tuple[Ended, Ended]:
    """Replay a recording in a daemon process as fast as it goes, and listen in another: (daemon, listener)."""
    address = f"ipc://{folder}/bus"
    replay = ("--replay", recording, "--speed", "max", "--bind", address, "--await-subscriber", PATIENCE_S)
    topics = [part for topic in ("touch", "key", "health") for part in ("--topic", topic)]
    listen = ("listen", address, *topics, "--json", "--until-stopped", "--timeout", PATIENCE_S)
    with started(*replay, *options, **variables) as daemon, started(*listen) as listener:
        heard = end(listener)
        return end(daemon), heard


def wait_until(done: Callable[[], object]) -> None:
    """Return once something holds."""
    until = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < until
        time.sleep(0.01)


def until(events: Subscriber[Event], what: Callable[[Event], bool]) -> list[Event]:
    """Receive events up to one that is so."""
    heard: list[Event] = []
    for event in events:
        heard.append(event)
        if what(event):
            return heard
    raise AssertionError("the subscription has ended")
