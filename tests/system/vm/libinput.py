"""What libinput saw of a touch screen, and what it should have seen of the bus."""

from __future__ import annotations

import json
import re
from typing import NamedTuple

TOLERANCE_MM = 0.1
_TOUCH = re.compile(r"TOUCH_(DOWN|MOTION|UP|CANCEL)\s+\S+\s+(\d+) \(\d+\)(?:.*\(\s*([\d.]+)/\s*([\d.]+)mm\))?")
Contacts = list[tuple[int, str, float, float]]
"""Id, phase, x and y in mm, of one message."""


class Event(NamedTuple):
    """One touch event."""

    kind: str
    slot: int
    x_mm: float = 0.0
    y_mm: float = 0.0

    def is_near(self, other: Event) -> bool:
        """Whether it is the same, but for a tenth of a millimetre."""
        off_mm = max(abs(self.x_mm - other.x_mm), abs(self.y_mm - other.y_mm))
        return self[:2] == other[:2] and off_mm <= TOLERANCE_MM


def seen(text: str) -> list[list[Event]]:
    """The frames of `libinput debug-events`, each with its events by slot."""
    frames: list[list[Event]] = [[]]
    for line in text.splitlines():
        found = _TOUCH.search(line)
        if found:
            kind, slot, x, y = found.groups()
            frames[-1].append(Event(kind, int(slot), float(x or 0), float(y or 0)))
        elif "TOUCH_FRAME" in line:
            frames.append([])
    return [sorted(frame, key=lambda event: event.slot) for frame in frames if frame]


def messages(text: str) -> list[Contacts]:
    """The messages of `touchd listen --json`, or of screenbus.py."""
    found = []
    for line in map(json.loads, text.splitlines()):
        contacts = [c if isinstance(c, list) else [c["id"], c["phase"], c["x_mm"], c["y_mm"]]
                    for c in line.get("contacts", [])]  # fmt: skip
        found.append([(int(n), str(phase), float(x), float(y)) for n, phase, x, y in contacts])
    return [contacts for contacts in found if contacts]


def wanted(bus: list[Contacts]) -> list[list[Event]]:
    """The frames that libinput should see of these messages; a touch that began before the first of them presses
    nothing."""
    slots: dict[int, tuple[int, float, float]] = {}
    frames = []
    for contacts in bus:
        free = [slot for slot in range(5) if slot not in {taken[0] for taken in slots.values()}]
        frame = []
        for number, phase, x, y in contacts:
            if number not in slots and phase != "down":
                continue
            if phase == "up":
                frame.append(Event("UP", slots.pop(number)[0]))
            elif number not in slots:
                slots[number] = (free.pop(0), x, y)
                frame.append(Event("DOWN", *slots[number]))
            elif (round(x, 2), round(y, 2)) != tuple(round(at, 2) for at in slots[number][1:]):
                slots[number] = (slots[number][0], x, y)
                frame.append(Event("MOTION", *slots[number]))
        if frame:
            frames.append(sorted(frame, key=lambda event: event.slot))
    return frames


def ways(frames: list[list[Event]]) -> list[list[Event]]:
    """Each touch from its down to its up, in the order of their ends; those that do not end are left out."""
    begun: dict[int, list[Event]] = {}
    found = []
    for event in (event for frame in frames for event in frame):
        if event.kind == "DOWN":
            begun[event.slot] = []
        if event.slot in begun:
            begun[event.slot].append(event)
            if event.kind == "UP":
                found.append(begun.pop(event.slot))
    return found


def same(one: list[Event], other: list[Event]) -> bool:
    """Whether two courses of events are the same."""
    return len(one) == len(other) and all(a.is_near(b) for a, b in zip(one, other, strict=True))
