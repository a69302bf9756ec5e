"""A bus for `touchd input`, in the place of the daemon's: plays scenes of fingers that standard input names.

Each scene ends with a line on standard output, as each message does: what libinput has to show.
"""

from __future__ import annotations

import grp
import json
import os
import sys
import threading
import time
from datetime import UTC, datetime
from itertools import count, cycle
from pathlib import Path

import zmq

from touchd.event import Contact, Phase, TouchEvent, encode

ADDRESS = Path("/run/touchd/bus")
FRAME_S = 0.05
STEPS = 6
ids, numbers = count(1), count(1)
lock = threading.Lock()
flooding, playing = threading.Event(), threading.Lock()
held: int | None = None
Way = tuple[tuple[float, float], tuple[float, float]]


def finger(number: int, phase: Phase, x_mm: float, y_mm: float) -> Contact:
    return Contact(number, phase, x_mm, y_mm, 0.5, 0.3, 0.9, 0.0, 0.0)


def publish(*contacts: Contact) -> None:
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    event = TouchEvent("touchd", next(numbers), time.monotonic_ns(), now, 0, list(contacts))
    bus.send_multipart([b"touch", encode(event)])
    print(json.dumps({"contacts": [[c.id, c.phase, c.x_mm, c.y_mm] for c in contacts]}), flush=True)


def play(ways: list[Way]) -> None:
    """Move fingers along straight ways, each ((x, y), (x, y)) in mm, from down to up."""
    fingers = {next(ids): way for way in ways}
    for step in range(STEPS + 1):
        phase: Phase = "down" if step == 0 else "up" if step == STEPS else "move"
        share = min(step, STEPS - 1) / (STEPS - 1)
        publish(*(finger(n, phase, a + share * (c - a), b + share * (d - b))
                  for n, ((a, b), (c, d)) in fingers.items()))  # fmt: skip
        time.sleep(FRAME_S)


SCENES: dict[str, list[list[Way]]] = {
    "tap": [[((50, 60), (50, 60))]],
    "swipe": [[((20, 100), (180, 100.37))]],
    "pinch": [[((60, 60), (95, 95)), ((140, 140), (105, 105))]],
    "five": [[((20 + 40 * n, 30 + 10 * n), (20 + 40 * n, 35.5 + 10 * n)) for n in range(5)]],
    "corner": [[((0, 0), (0, 0))], [((200, 150), (200, 150))]],
}


def hold() -> None:
    """Repeat a finger that lies still, as the daemon does."""
    while True:
        time.sleep(0.1)
        with lock:
            if held is not None:
                publish(finger(held, "hold", 120.0, 40.0))


def flood() -> None:
    """Play scenes without an end while `flooding` is set."""
    for name in cycle(("five", "pinch", "tap", "swipe")):
        flooding.wait()
        with playing:
            for ways in SCENES[name]:
                play(ways)


ADDRESS.parent.mkdir(exist_ok=True)
bus: zmq.Socket[bytes] = zmq.Context().socket(zmq.XPUB)
bus.setsockopt(zmq.XPUB_VERBOSE, 1)  # each subscriber is heard of
bus.bind(f"ipc://{ADDRESS}")
os.chown(ADDRESS, -1, grp.getgrnam("touchd-bus").gr_gid)
ADDRESS.chmod(0o660)
threading.Thread(target=hold, daemon=True).start()
threading.Thread(target=flood, daemon=True).start()
for line in sys.stdin:
    command = line.strip()
    with lock:
        if command == "wait":
            while bus.poll(150_000) and bus.recv() != b"\1touch":
                pass
        elif command == "hold":
            held = next(ids)
            publish(finger(held, "down", 120.0, 40.0))
        elif command == "release":
            assert held is not None
            publish(finger(held, "up", 120.0, 40.0))
            held = None
        elif command == "silence":
            held = None
        elif command == "flood":
            flooding.set()
        elif command == "calm":
            flooding.clear()
            with playing:  # the scene that is being played is over
                while bus.poll(0):
                    bus.recv()
        else:
            for ways in SCENES[command]:
                play(ways)
    print(json.dumps({"done": command}), flush=True)
