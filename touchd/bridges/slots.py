"""Fingers as the bytes of the kernel's multi-touch protocol B: a pure function.

Source: Linux, Documentation/input/multi-touch-protocol.rst, and linux/input-event-codes.h.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

from msgspec import Struct

from touchd.bridges.area import Place

EV_SYN, EV_KEY, EV_ABS = 0, 1, 3
SYN_REPORT = 0
BTN_TOUCH = 0x14A
ABS_X, ABS_Y, ABS_PRESSURE = 0x00, 0x01, 0x18
ABS_MT_SLOT, ABS_MT_TRACKING_ID, ABS_MT_PRESSURE = 0x2F, 0x39, 0x3A
ABS_MT_POSITION_X, ABS_MT_POSITION_Y = 0x35, 0x36
ABS_MT_TOUCH_MAJOR, ABS_MT_TOUCH_MINOR, ABS_MT_ORIENTATION = 0x30, 0x31, 0x34
_SIZE = ABS_MT_TOUCH_MAJOR, ABS_MT_TOUCH_MINOR, ABS_MT_ORIENTATION
PER_MM = 100
"""Units of a position or length: hundredths of a millimetre."""
PRESSURE_MAX = 1000
SIZE_MAX = 100 * PER_MM
UNKNOWN_SIZE = 1, 1, 0
"""Axes of a contact that does not say them: lengths of 0 would be no touch."""
SLOTS = 5
"""Most fingers at once, as libinput names them; further ones wait for a free slot."""
LIFTED = -1
Slots = dict[int, int]
"""The slot of each finger, by its number."""


def _head(kind: int, code: int) -> bytes:
    """Return a `struct input_event` without its value; the kernel sets the time."""
    return struct.pack("@llHH", 0, 0, kind, code)


_SLOT, _ID, _TOUCHED = _head(EV_ABS, ABS_MT_SLOT), _head(EV_ABS, ABS_MT_TRACKING_ID), _head(EV_KEY, BTN_TOUCH)
_AT = tuple(_head(EV_ABS, code) for code in (ABS_MT_POSITION_X, ABS_MT_POSITION_Y, ABS_MT_PRESSURE, *_SIZE))
_POINTER = tuple(_head(EV_ABS, code) for code in (ABS_X, ABS_Y, ABS_PRESSURE))
_REPORT = _head(EV_SYN, SYN_REPORT)
_one, _two, _three, _five, _seven = (struct.Struct("@" + f"{len(_SLOT)}si" * n).pack for n in (1, 2, 3, 5, 7))


class Finger(Struct, gc=False):
    """One finger in the device's units."""

    x: int
    y: int
    pressure: int
    """1 to `PRESSURE_MAX`: 0 would be no touch."""
    size: tuple[int, int, int] = UNKNOWN_SIZE
    """Long and short axis, and the angle of the long one from the y axis, clockwise, -90 to 90 degrees."""


def fingers_at(places: Mapping[int, Place]) -> dict[int, Finger]:
    """Return the fingers in the device's units."""
    fingers = {}
    for number, place in places.items():
        contact, size = place.contact, UNKNOWN_SIZE
        if contact.major_mm and contact.minor_mm:
            major, minor = round(contact.major_mm * PER_MM), round(contact.minor_mm * PER_MM)
            turned = round(place.angle_deg % 180.0 - 90.0)
            size = min(max(major, 1), SIZE_MAX), min(max(minor, 1), SIZE_MAX), turned
        pressure = min(max(round(contact.force * PRESSURE_MAX), 1), PRESSURE_MAX)
        fingers[number] = Finger(round(place.x_mm * PER_MM), round(place.y_mm * PER_MM), pressure, size)
    return fingers


def encode(slots: Slots, fingers: Mapping[int, Finger]) -> tuple[bytes, Slots]:
    """Return one frame of events for the fingers that are down now, and who has which slot after it.

    Lifts come first, then the fingers, then the one finger of programs that know no slots, the oldest; SYN_REPORT ends
    the frame. A slot that this frame frees is taken by no finger of this frame: a reader that looks at each frame's
    end alone would take both for one.
    """
    events = []
    after: Slots = {}
    for number, slot in slots.items():
        if number in fingers:
            after[number] = slot
        else:
            events.append(_two(_SLOT, slot, _ID, LIFTED))
    x, y, pressure, major, minor, angle = _AT
    for number, one in fingers.items():
        own = after.get(number)
        if own is None:
            free = {*range(SLOTS)}.difference(slots.values(), after.values())
            if not free:
                continue
            own = after[number] = min(free)
            events.append(_two(_SLOT, own, _ID, number & 0xFFFF))
        long, short, turned = one.size
        events.append(
            _seven(_SLOT, own, x, one.x, y, one.y, pressure, one.pressure, major, long, minor, short, angle, turned)
        )
    x, y, pressure = _POINTER
    if after:
        oldest = fingers[min(after)]
        events.append(_five(_TOUCHED, 1, x, oldest.x, y, oldest.y, pressure, oldest.pressure, _REPORT, 0))
    else:
        events.append(_three(_TOUCHED, 0, pressure, 0, _REPORT, 0))
    return b"".join(events), after


def pack(*events: tuple[int, int, int]) -> bytes:
    """Return the bytes of events, each its type, code and value."""
    return b"".join([_one(_head(kind, code), value) for kind, code, value in events])


def lift_all() -> bytes:
    """Return the frame that empties every slot, whoever has it."""
    return encode({slot: slot for slot in range(SLOTS)}, {})[0]
