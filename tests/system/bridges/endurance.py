"""What `touchd input` stands, and what it costs: `python -m tests.system.bridges.endurance` prints it, in minutes.

1,000,000 frames with floods of taps through a bus and the bridge's process; 10,000 kills of daemon, bus and bridge
against the model of the kernel's slots; the time from a message to its events beside a subscriber's alone; memory, and
processor time at 125 frames a second.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import select
import statistics
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from tests.processes import PATIENCE_S, ROOT, environment
from tests.system.bridges.rig import Bridge, Daemon, bridge, daemon
from tests.unit.bridges.events import MS, contact, health, touch
from tests.unit.bridges.kernel import Kernel
from touchd.bridges.area import Area
from touchd.bridges.bridge import Following
from touchd.bridges.screen import Screen
from touchd.bridges.uinput import SLOTS
from touchd.config.schema import InputSettings
from touchd.event import Contact, Phase

SETTINGS = InputSettings(screen_mm=(0, 0, 200, 100))
IN_FLIGHT = 30
"""Frames that fit into the pipe, 64 KiB, which the kernel's uinput does not have: there a write never waits."""
Places = list[tuple[int, int]]


def taps(rng: random.Random) -> Iterator[list[Contact]]:
    """Yield frames of up to five fingers that come and go, often each frame; each frame's places are its own."""
    down: list[int] = []
    following, k = 1, 0
    while True:
        k += 1
        gone = [n for n in down if rng.random() < 0.4]
        come: list[int] = []
        while len(down) + len(come) < SLOTS and rng.random() < 0.5:
            come.append(following)
            following += 1
        if down or come:
            phases: list[tuple[int, Phase]] = [(n, "up" if n in gone else "move") for n in down]
            phases += [(n, "down") for n in come]
            yield [contact(n, phase, k % 20000 / 100, n % 10000 / 100) for n, phase in phases]
        down = [n for n in down if n not in gone] + come


def through_the_bus(folder: Path, frames: int, seed: int = 0) -> tuple[int, int]:
    """Send frames to a bridge's process; return how many reports differ from their frame, and how many are missing."""
    with daemon(folder) as bus, bridge(folder, bus, PATIENT="1") as screen:
        source, expected = taps(random.Random(seed)), deque[Places]()
        sent = seen = wrong = 0
        deadline_s = time.monotonic() + PATIENCE_S
        while seen < frames and time.monotonic() < deadline_s:
            while sent < frames and sent - seen < IN_FLIGHT:
                contacts = next(source)
                bus.touch(*contacts)
                expected.append(sorted((round(c.x_mm * 100), round(c.y_mm * 100)) for c in contacts if c.phase != "up"))
                sent += 1
            select.select([screen.reader], [], [], 1.0)
            screen.pump()
            for report in screen.kernel.reports:
                deadline_s = time.monotonic() + PATIENCE_S
                wrong += expected.popleft() != sorted((one["x"], one["y"]) for one in report.fingers.values())
                seen += 1
            screen.kernel.reports.clear()
            screen.arrived_ns.clear()
        return wrong, frames - seen


def kills(count: int, seed: int = 0) -> int:
    """Play taps, and kill daemon, bus or bridge at random; return how often a finger stayed down after it."""
    rng = random.Random(seed)
    stuck, now_ns, frames = 0, 0, taps(rng)
    kernel = Kernel()
    following, screen = Following(), Screen(Area(SETTINGS), kernel)
    for _ in range(count):
        for _ in range(rng.randrange(8)):
            now_ns += 8 * MS
            if following.take(touch(*next(frames), t_ns=now_ns), now_ns):
                screen.show(following.down, now_ns)
        who = rng.choice(["daemon", "daemon, said", "messages", "bridge", "bridge, asked"])
        if who == "daemon, said" and following.take(health("stopping"), now_ns):
            screen.show(following.down, now_ns)
        elif who == "messages":  # lost on the way: the next frame says all
            for _ in range(rng.randrange(1, 5)):
                next(frames)
            continue
        elif who in ("bridge", "bridge, asked"):
            screen.close() if who == "bridge, asked" else kernel.close()
            stuck += bool(kernel.live)
            kernel = Kernel()
            following, screen = Following(), Screen(Area(SETTINGS), kernel)
        now_ns += 300 * MS
        if following.check(now_ns):
            screen.show(following.down, now_ns)
        stuck += bool(kernel.live)
        if who.startswith("daemon"):
            frames = taps(rng)
        kernel.reports.clear()
    return stuck


def latency_us(folder: Path, messages: int) -> tuple[list[float], list[float]]:
    """Return the times of the same messages until a subscriber has them, and until their events can be read, us."""
    with daemon(folder) as bus, bridge(folder, bus, PATIENT="1") as screen:
        code = "import sys; from tests.system.bridges.endurance import listen; listen(sys.argv[1], int(sys.argv[2]))"
        alone = subprocess.Popen([sys.executable, "-c", code, bus.address, str(messages)], stdout=subprocess.PIPE,
                                 text=True, cwd=ROOT, env=environment())  # fmt: skip
        with alone:
            bus.wait()
            through = [_one(bus, screen, k) for k in range(messages)]
            said, _ = alone.communicate(timeout=PATIENCE_S)
        return json.loads(said), through


def _one(bus: Daemon, screen: Bridge, k: int) -> float:
    time.sleep(0.008)
    sent_ns = bus.touch(*([contact(k, "up")] if k else []), contact(k + 1, "down", k % 200, 50.0))
    select.select([screen.reader], [], [], PATIENCE_S)
    read_ns = time.monotonic_ns()
    screen.pump()
    return (read_ns - sent_ns) * 1e-3


def listen(address: str, messages: int) -> None:
    """Print how long messages took to come here, us."""
    from touchd.client import Subscriber

    with Subscriber(address) as events:
        took = [(-event.t_ns + time.monotonic_ns()) * 1e-3 for _, event in zip(range(messages), events, strict=False)]
    print(json.dumps(took))


def upkeep(folder: Path, fingers: int, frames: int) -> tuple[float, float]:
    """Return the processor time that a bridge takes at 125 frames a second, % of a core, and its memory, MB."""
    with daemon(folder) as bus, bridge(folder, bus, PATIENT="1") as screen:
        process = Path(f"/proc/{screen.process.pid}")
        bus.touch(*(contact(n, "down") for n in range(fingers)))
        select.select([screen.reader], [], [], PATIENCE_S)
        began_ns, spent_ns = time.monotonic_ns(), _spent_ns(process)
        for k in range(1, frames + 1):
            time.sleep(max(0.0, (began_ns - time.monotonic_ns()) * 1e-9 + k / 125))
            bus.touch(*(contact(n, "move", (k + n) % 200, 40.0 + n) for n in range(fingers)))
            screen.pump()
        share = (_spent_ns(process) - spent_ns) / (frames / 125 * 1e9)
        rss_kb = re.findall(r"VmRSS:\s*(\d+) kB", (process / "status").read_text())[0]
        return 100 * share, int(rss_kb) * 1e-3


def _spent_ns(process: Path) -> int:
    """Return what all threads of a process have spent on processors."""
    return sum(int(file.read_text().split()[0]) for file in process.glob("task/*/schedstat"))


def main() -> None:
    """Measure all in full."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    frames, times = int(os.environ.get("FRAMES", "1000000")), int(os.environ.get("KILLS", "10000"))
    print(f"{kills(times)} of {times} kills left a finger down", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        alone, through = (sorted(took) for took in latency_us(Path(folder), 5000))
    for name, took in (("bus alone", alone), ("to the event", through)):
        print(f"{name}: median {statistics.median(took):.0f} us, 99.9 % {took[int(len(took) * 0.999)]:.0f} us")
    for fingers in (1, 5):
        with tempfile.TemporaryDirectory() as folder:
            percent, rss_mb = upkeep(Path(folder), fingers, 7500)
        print(f"{fingers} moving at 125 frames/s: {percent:.1f} % of a core, {rss_mb:.1f} MB", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        wrong, missing = through_the_bus(Path(folder), frames)
    print(f"{frames} frames: {wrong} wrong or out of order, {missing} lost")


if __name__ == "__main__":
    main()
