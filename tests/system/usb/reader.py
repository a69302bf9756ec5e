"""Reads a live source as the service does, and keeps what comes out of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from msgspec.structs import replace

from tests.processes import PATIENCE_S
from touchd.event import State
from touchd.frame import Frame
from touchd.sources.daq import Waits
from touchd.sources.live import DaqSource
from touchd.sources.source import Change
from touchd.sources.usb_protocol import Info

INFO = Info(channels=4, samples=250, sample_rate_hz=250_000, min_frame_rate_hz=10, firmware=(1, 2, 3))
"""What the shipped model was trained with."""
QUICK = Waits(read_s=0.02)
"""A source that soon notices that it is closed."""


def wait(done: Callable[[], Any]) -> None:
    """Wait until it is so, without reading."""
    until = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < until, "it never came"
        time.sleep(0.001)


class Reader:
    """What comes out of a source, in order."""

    def __init__(self, source: DaqSource) -> None:
        self.source = source
        self.states: list[State] = []
        self.changes: list[Change] = []
        self.frames: list[Frame] = []

    def step(self) -> Frame | None:
        frame = self.source.read(0.05)
        if frame is not None:
            self.frames.append(replace(frame, counts=frame.counts.copy()))
        for change in self.source.changes():
            self.changes.append(change)
            if not self.states or change.state != self.states[-1]:
                self.states.append(change.state)
        return frame

    def until(self, done: Callable[[], Any], what: str = "") -> None:
        """Read until it is so."""
        until = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < until, what or f"after {self.changes} and {len(self.frames)} frames"
            self.step()

    def until_state(self, state: State, count: int = 1) -> None:
        self.until(lambda: self.states.count(state) >= count, f"never {state}: {self.changes}")

    def until_frames(self, count: int) -> None:
        self.until(lambda: len(self.frames) >= count)

    def error(self) -> Exception:
        """Read until an error is raised, and return it."""
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            try:
                self.step()
            except Exception as error:
                return error
        raise AssertionError("no error was raised")

    @property
    def sequence(self) -> list[int]:
        return [frame.sequence for frame in self.frames]


Read = Callable[..., Reader]
"""The fixture `read`: opens a source."""
