"""The one loop over a source's frames."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from touchd.errors import DeviceLost
from touchd.frame import Acquisition, Frame
from touchd.service.runner import READ_TIMEOUT_S, frames_of
from touchd.sources.source import Change, EndOfStream, Source

PACKAGE = Path(__file__).resolve().parents[3] / "touchd"
LOST, BACK = Change("lost", "unplugged"), Change("streaming", "frames arrive")


class Script(Source):
    """A source that does what is written down: a frame, silence, changes of state, or an error; then it ends."""

    def __init__(self, steps: Sequence[int | list[Change] | Exception | None]) -> None:
        self.acquisition = Acquisition(channels=1, samples=1, sample_rate_hz=250e3)
        self.timeouts_s: list[float] = []
        self._steps = list(steps)
        self._changes: list[Change] = []

    def read(self, timeout_s: float) -> Frame | None:
        assert not self._changes, "they are taken before the next read"
        self.timeouts_s.append(timeout_s)
        step = self._steps.pop(0) if self._steps else EndOfStream()
        if isinstance(step, Exception):
            raise step
        if isinstance(step, list):
            self._changes = step
            return None
        return None if step is None else Frame(np.zeros((1, 1), np.int16), step, step, step)

    def changes(self) -> list[Change]:
        taken, self._changes = self._changes, []
        return taken

    def close(self) -> None:
        raise AssertionError("the source belongs to the caller")


def numbers(script: Script) -> list[int | None]:
    return [None if frame is None else frame.sequence for frame in frames_of(script)]


def test_to_the_end() -> None:
    """Every frame comes in order, None for each silence, until the source ends."""
    script = Script([1, None, 2, 3])
    assert numbers(script) == [1, None, 2, 3]
    assert script.timeouts_s == [READ_TIMEOUT_S] * 5


def test_changes() -> None:
    """The changes of a live source are reported before anything else happens."""
    seen: list[object] = []
    for frame in frames_of(Script([1, [LOST, BACK], 2]), on_change=seen.append):
        seen.append(None if frame is None else frame.sequence)
    assert seen == [1, LOST, BACK, None, 2]


def test_stop() -> None:
    """No frame is read ahead: a caller that leaves its loop leaves the rest to the next one."""
    script = Script([1, 2, 3])
    for frame in frames_of(script, 0.2):
        if frame is not None and frame.sequence == 2:
            break
    assert script.timeouts_s == [0.2, 0.2]
    assert numbers(script) == [3]


def test_failure() -> None:
    """What a source raises comes out, after the frames before it."""
    coming = frames_of(Script([1, DeviceLost("gone")]))
    assert next(coming) is not None
    with pytest.raises(DeviceLost):
        next(coming)


def test_there_is_no_other_loop() -> None:
    """One module alone waits for the end of a source; whoever wants frames asks it."""
    loops = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.is_relative_to(PACKAGE / "sources"):
            continue
        text = path.read_text()
        if "EndOfStream" not in text and "source.read(" not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ExceptHandler) and node.type is not None and "EndOfStream" in ast.dump(node.type):
                loops.add(str(path.relative_to(PACKAGE)))
            called = node.func if isinstance(node, ast.Call) else None
            if isinstance(called, ast.Attribute) and called.attr == "read" and "source" in ast.dump(called.value):
                loops.add(str(path.relative_to(PACKAGE)))
    assert loops == {"service/runner.py"}
