"""A small model of what Linux does with a multi-touch device: slots, and the state at each SYN_REPORT."""

from __future__ import annotations

import struct
from typing import NamedTuple

from touchd.bridges import uinput

EVENT = struct.Struct("@llHHi")
AXES = {uinput.ABS_MT_POSITION_X: "x", uinput.ABS_MT_POSITION_Y: "y", uinput.ABS_MT_PRESSURE: "pressure",
        uinput.ABS_MT_TOUCH_MAJOR: "major", uinput.ABS_MT_TOUCH_MINOR: "minor", uinput.ABS_MT_ORIENTATION: "angle",
        }  # fmt: skip
Values = dict[str, int]


class Report(NamedTuple):
    """What a reader sees at a SYN_REPORT."""

    fingers: dict[int, Values]
    """By slot: `id`, `x`, `y`, `pressure`, and the size if there is one."""
    touched: bool
    pointer: tuple[int, int, int]
    """x, y and pressure for programs that know no slots."""


class Kernel(uinput.Device):
    """Takes what is written to the device."""

    def __init__(self) -> None:
        self.slots: list[Values] = [{"id": uinput.LIFTED} for _ in range(uinput.SLOTS)]
        self.slot = 0
        self.keys: dict[int, int] = {}
        self.pointer = {uinput.ABS_X: 0, uinput.ABS_Y: 0, uinput.ABS_PRESSURE: 0}
        self.reports: list[Report] = []
        self.closed = False
        self.writes = 0
        self._freed: set[int] = set()

    def write(self, frame: bytes) -> None:
        """Take one write, which is one whole frame."""
        assert not self.closed
        assert len(frame) % EVENT.size == 0
        self.writes += 1
        events = list(EVENT.iter_unpack(frame))
        assert [event[2:] for event in events].count((uinput.EV_SYN, uinput.SYN_REPORT, 0)) == 1
        for _, _, kind, code, value in events:
            self._take(kind, code, value)
        assert events[-1][2] == uinput.EV_SYN

    def close(self) -> None:
        """The device is removed: the kernel lifts what is down."""
        self.closed = True
        self.slots = [{"id": uinput.LIFTED} for _ in range(uinput.SLOTS)]
        self.keys.clear()

    @property
    def live(self) -> dict[int, Values]:
        """The slots that hold a finger."""
        return {n: dict(slot) for n, slot in enumerate(self.slots) if slot["id"] != uinput.LIFTED}

    def _take(self, kind: int, code: int, value: int) -> None:
        if kind == uinput.EV_SYN:
            assert self.keys.get(uinput.BTN_TOUCH, 0) == bool(self.live) or uinput.BTN_TOUCH not in self.keys
            x, y, pressure = self.pointer.values()
            self.reports.append(Report(self.live, bool(self.keys.get(uinput.BTN_TOUCH)), (x, y, pressure)))
            self._freed.clear()
        elif kind == uinput.EV_KEY:
            self.keys[code] = value
        elif code == uinput.ABS_MT_SLOT:
            assert 0 <= value < uinput.SLOTS
            self.slot = value
        elif code == uinput.ABS_MT_TRACKING_ID:
            if value == uinput.LIFTED:
                self._freed.add(self.slot)
                self.slots[self.slot] = {"id": uinput.LIFTED}
            else:
                assert self.slots[self.slot]["id"] == uinput.LIFTED, "a finger must lift before another has its slot"
                assert self.slot not in self._freed, "never in the same frame"
                self.slots[self.slot] = {"id": value}
        elif code in AXES:
            assert self.slots[self.slot]["id"] != uinput.LIFTED
            self.slots[self.slot][AXES[code]] = value
        else:
            assert code in self.pointer
            self.pointer[code] = value
