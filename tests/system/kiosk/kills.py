"""Kill `touchd input` again and again, with and without fingers down.

`python kills.py TIMES` prints a line of JSON: how many slots of the kernel held a finger at each kill, and in the end.
The bridges are forks of one process that has loaded all: to start Python 100 times would take an emulated processor
ten minutes.
"""

from __future__ import annotations

import fcntl
import json
import os
import random
import signal
import struct
import sys
import time
from pathlib import Path

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


def bridge() -> tuple[int, Path]:
    """Start a bridge; its process and its screen."""
    process = os.fork()
    if not process:
        command.main(["--bus", "ipc:///run/touchd/bus"])
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        if (screen := node()) is not None and screen.exists():
            return process, screen
        time.sleep(0.02)
    raise SystemExit("no screen came")


def main(times: int) -> None:
    draw = random.Random(1)
    held = []
    for number in range(times):
        process, screen = bridge()
        for _ in range(500 if number % 4 else 1):  # a quarter at any moment, the others with a finger down
            time.sleep(draw.uniform(0.02, 0.2))
            if down := fingers(screen):
                break
        held.append(down)
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        while node() is not None:
            time.sleep(0.02)
    process, screen = bridge()
    time.sleep(2)
    os.kill(process, signal.SIGTERM)
    os.waitpid(process, 0)
    print(json.dumps({"held": held, "left": node() is not None}), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
