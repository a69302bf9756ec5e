"""A bus with five fingers on it, as a daemon would publish it: `python -m tests.system.web.bus ADDRESS`.

What a page shows of it depends on neither the twin nor the speed of the computer.
"""

from __future__ import annotations

import math
import sys
import time
from datetime import UTC, datetime, timedelta
from itertools import count
from typing import Any

import zmq

from touchd.event import Contact, Event, HealthEvent, Latency, Phase, PlateEvent, PlateKey, SpectrumEvent, TouchEvent
from touchd.event import encode as encoded

RATE_HZ = 125
SHOWN = 5
"""Publish each fifth frame alone: of more, too, a page gets the newest, and a frame in between costs as much as any."""
BINS, CHANNELS = 49, 4
WRONG = {
    "ill": {"reason": "channel 3 is dead"},
    "starting": {
        "state": "starting",
        "reason": "device: no touchd gadget among the 7 devices on USB; the audio interface 'pane 1' is not there ->"
        " plug it in, or add --replay FILE or --simulate SCENE",
    },
}
"""What the health says otherwise, by option."""
_KEYS = [PlateKey(str(n + 1), 40.0 + 42 * (n % 3), 40.0 + 42 * (n // 3), 36.0, 36.0) for n in range(9)]


class Bus:
    """Publishes what `Player` makes; a subscriber to come gets the plate and the health."""

    def __init__(self, address: str, *, keypad: bool = False) -> None:
        self._seq = {topic: count(1) for topic in ("touch", "health", "spectrum", "plate")}
        self._keypad = keypad
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(address)
        self.wanted: set[str] = set()

    def stamp(self, topic: str) -> tuple[str, int, int, str]:
        return "pane 1", next(self._seq[topic]), time.monotonic_ns(), datetime.now(UTC).isoformat()

    def publish(self, event: Event) -> None:
        self._socket.send_multipart([event.type.encode(), encoded(event)])

    def poll(self) -> None:
        """Take subscriptions; send the plate to those to come."""
        while self._socket.poll(0):
            said = self._socket.recv()
            topic = said[1:].decode()
            (self.wanted.add if said[:1] == b"\1" else self.wanted.discard)(topic)
            if said[:1] == b"\1" and topic == "plate":
                self.plate()

    def plate(self) -> None:
        self.publish(PlateEvent(
            *self.stamp("plate"), 200.0, 200.0, float(RATE_HZ), CHANNELS, 500, 500_000.0, (50_000.0, 100_000.0), "bus",
            (30.0, 100.0), [(15.0, 15.0), (185.0, 20.0), (180.0, 185.0), (20.0, 170.0)],
            _KEYS if self._keypad else [],
        ))  # fmt: skip

    def health(self, frames: int, state: Any = "streaming", **fields: object) -> None:
        self.publish(HealthEvent(
            *self.stamp("health"), state, frames, 3, 0,
            {"learning": 32, "gate": frames // 5, "faint": 2, "still": frames // 10, "tracking": frames // 2},
            frames // 6, Latency(310.0 + frames % 60, 840.0 + frames % 230, 1300.0), 4.6, 0.4, "regression", "0.1.0",
            noise_channels=[4.4, 4.7, 4.5, 4.9], stretch_ppm=-41.0, clock_ppm=12.3, **fields,  # type: ignore[arg-type]  # of mixed types
        ))  # fmt: skip

    def touch(self, frame: int, contacts: list[Contact]) -> None:
        self.publish(TouchEvent(*self.stamp("touch"), frame, contacts, latency_us=312.0))

    def spectrum(self, frame: int) -> None:
        def part(channel: int, b: int, phase: float) -> float:
            hump = 40 * math.exp(-(((b - 12 - 7 * channel) / 6) ** 2)) + 18 * math.exp(
                -(((b - 36 + 3 * channel) / 5) ** 2)
            )
            return (hump + 2) * math.cos(0.4 * b + 0.02 * frame + phase)

        features = [part(c, b, p) for c in range(CHANNELS) for p in (0.0, -math.pi / 2) for b in range(BINS)]
        self.publish(SpectrumEvent(*self.stamp("spectrum"), frame, features))

    def close(self) -> None:
        self._socket.close()
        self._context.term()


def five(frame: int, phase: Phase = "move") -> list[Contact]:
    """Five fingers on circles of their own."""
    t = frame / RATE_HZ
    centres = ((55, 60), (100, 40), (145, 62), (135, 140), (70, 145))
    return [
        Contact(
            n + 1, phase, x + 14 * math.cos(1.1 * t + n), y + 14 * math.sin(1.1 * t + n), 0.3 + 0.14 * n,
            0.08 + 0.25 * n * n / 4, 0.98, -15 * math.sin(1.1 * t + n), 15 * math.cos(1.1 * t + n),
            area_mm2=80.0 + 15 * n, major_mm=11.0 + n, minor_mm=8.0 + 0.6 * n, angle_deg=30.0 * n - 60,
            kind="thumb" if n == 4 else "finger",
        )
        for n, (x, y) in enumerate(centres)
    ]  # fmt: skip


def lifted(bus: Bus) -> None:
    """Publish, each second, that the last finger was lifted a minute ago."""
    wall = (datetime.now(UTC) - timedelta(minutes=1)).isoformat()
    at_ns = time.monotonic_ns() - 60_000_000_000
    while True:
        bus.poll()
        bus.publish(TouchEvent("pane 1", 1, at_ns, wall, 0, five(0, "up"), latency_us=312.0))
        bus.health(0)
        time.sleep(1.0)  # as often as a daemon at rest


def play(bus: Bus, rate_hz: float = RATE_HZ, step: int = SHOWN, **wrong: Any) -> None:
    """Publish five fingers in each frame that is so many after the last, and what is wrong."""
    begin_s, frame = time.monotonic(), 0
    while True:
        bus.poll()
        bus.touch(frame, five(frame, "move" if frame else "down"))
        if "spectrum" in bus.wanted:
            bus.spectrum(frame)
        if frame % RATE_HZ == 0:
            bus.health(frame, **wrong)
        frame += step
        time.sleep(max(0.0, begin_s + frame / rate_hz - time.monotonic()))


if __name__ == "__main__":
    wrong: dict[str, Any] = next((fields for option, fields in WRONG.items() if option in sys.argv), {})
    rate_hz, step = (40 * RATE_HZ, 1) if "hurried" in sys.argv else (RATE_HZ, SHOWN)
    if "lifted" in sys.argv:
        lifted(Bus(sys.argv[1]))
    play(Bus(sys.argv[1], keypad="keypad" in sys.argv), rate_hz, step, **wrong)
