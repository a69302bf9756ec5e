"""Kill `touchd input` again and again, with and without fingers down.

`python kills.py TIMES PROCESS` prints a line of JSON: how many slots of the kernel held a finger at each kill, and
whether a screen is left. PROCESS is libinput's: three of four kills wait until it has seen a finger.
The bridges are forks of one process that has loaded all: to start Python 100 times would take an emulated processor
ten minutes.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import random
import signal
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

import touchd.config.load  # noqa: F401 - each bridge's reader of the configuration is a fork too
from touchd.cli.input import command

SLOTS = 5
ABS_MT_TRACKING_ID = 0x39
EVIOCGMTSLOTS = 0x80000000 | (4 * (SLOTS + 1)) << 16 | ord("E") << 8 | 0x0A
PATIENCE_S = 300.0


def node() -> Path | None:
    """The touch screen's event device."""
    for name in Path("/sys/class/input").glob("event*/device/name"):
        if name.read_text().strip() == "touchd screen":
            return Path("/dev/input") / name.parent.parent.name
    return None


def fingers(screen: Path) -> int:
    """How many slots hold a finger."""
    answer = bytearray(struct.pack(f"<I{SLOTS}i", ABS_MT_TRACKING_ID, *[-1] * SLOTS))
    descriptor = os.open(screen, os.O_RDONLY)
    try:
        fcntl.ioctl(descriptor, EVIOCGMTSLOTS, answer)
    finally:
        os.close(descriptor)
    return sum(number >= 0 for number in struct.unpack(f"<I{SLOTS}i", answer)[1:])


def opened(process: int) -> list[str]:
    """What a process has open."""
    names = []
    for descriptor in Path(f"/proc/{process}/fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile
            names.append(os.readlink(descriptor))
    return names


def until(done: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not done():
        if time.monotonic() > end:
            raise SystemExit(what)
        time.sleep(0.02)


def bridge() -> tuple[int, Path]:
    """Start a bridge; its process and its screen."""
    process = os.fork()
    if not process:
        command.main(["--bus", "ipc:///run/touchd/bus"])
    until(lambda: (screen := node()) is not None and screen.exists(), "no screen came")
    screen = node()
    assert screen is not None
    return process, screen


def main(times: int, libinput: int) -> None:
    draw = random.Random(1)
    held = []
    for number in range(times):
        process, screen = bridge()
        seen = number % 4 > 0
        if seen:
            until(lambda: str(screen) in opened(libinput), "libinput did not open the screen")  # noqa: B023
            time.sleep(0.6)  # the fingers that it found down are lifted
        while True:
            time.sleep(draw.uniform(0.02, 0.2))
            down = fingers(screen)
            if down or not seen:
                break
        held.append(down)
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        until(lambda: node() is None, "a screen stayed")
    process, screen = bridge()
    until(lambda: str(screen) in opened(libinput), "libinput did not open the screen")
    time.sleep(2)
    os.kill(process, signal.SIGTERM)
    os.waitpid(process, 0)
    until(lambda: str(screen) not in opened(libinput), "libinput kept the screen open")
    print(json.dumps({"held": held, "left": node() is not None}), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
