"""A touch screen or a keypad of the kernel's, made through /dev/uinput, and fingers as its multi-touch protocol B.

Source: Linux, Documentation/input/uinput.rst and multi-touch-protocol.rst, linux/uinput.h and input-event-codes.h.
Whoever has /dev/uinput open can make a keyboard, and type: nothing else than this module opens it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
from collections.abc import Collection, Mapping
from pathlib import Path

from msgspec import Struct

from touchd.bridges.area import Place
from touchd.errors import BridgeError

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

NODE = Path("/dev/uinput")
DEVICES = Path("/sys/class/input")
SCREEN_NAME = "touchd screen"
KEYPAD_NAME = "touchd keypad"
BUS_VIRTUAL, VENDOR_ID, PRODUCT_ID, VERSION = 0x06, 0x1209, 0x0001, 1
INPUT_PROP_DIRECT = 0x01
UI_DEV_CREATE, UI_DEV_DESTROY = 0x5501, 0x5502
UI_DEV_SETUP, UI_ABS_SETUP = 0x405C5503, 0x401C5504
UI_SET_EVBIT, UI_SET_KEYBIT, UI_SET_PROPBIT = 0x40045564, 0x40045565, 0x4004556E
_POINTER_BYTES = struct.calcsize("P")
UI_SET_PHYS = 0x4000556C | _POINTER_BYTES << 16
_NAME_BYTES = 64
UI_GET_SYSNAME = 0x8000552C | _NAME_BYTES << 16

Axis = tuple[int, int, int, int]
"""Code, minimum, maximum, units per millimetre."""


def phys_of(device: str) -> str:
    """Return how the kernel names the place of a bridge's device, for a daemon's `device.name`."""
    return f"touchd/{device}"


def screen_axes(size_mm: tuple[float, float]) -> list[Axis]:
    """Return the axes of a touch screen. A maximum of exactly the size makes libinput report the size."""
    x, y = (round(length * PER_MM) for length in size_mm)
    return [
        (ABS_MT_SLOT, 0, SLOTS - 1, 0),
        (ABS_MT_TRACKING_ID, 0, 0xFFFF, 0),
        (ABS_MT_POSITION_X, 0, x, PER_MM),
        (ABS_MT_POSITION_Y, 0, y, PER_MM),
        (ABS_MT_PRESSURE, 0, PRESSURE_MAX, 0),  # a resolution would mean units per gram
        (ABS_X, 0, x, PER_MM),
        (ABS_Y, 0, y, PER_MM),
        (ABS_PRESSURE, 0, PRESSURE_MAX, 0),
        (ABS_MT_TOUCH_MAJOR, 0, SIZE_MAX, PER_MM),
        (ABS_MT_TOUCH_MINOR, 0, SIZE_MAX, PER_MM),
        (ABS_MT_ORIENTATION, -90, 90, 0),
    ]


class Device:
    """An input device of the kernel's. It ends with `close`, or with this process, however that ends.

    Udev rules and compositors match its `name`; only one device of a `phys` may be there. `keys` are the codes of its
    keys and buttons; a touch screen has `axes`.

    Raises BridgeError if the kernel has no uinput, this user may not use it, or the device is there already.
    """

    def __init__(self, name: str, phys: str, keys: Collection[int], axes: Collection[Axis] = ()) -> None:
        self._refuse_second(phys)
        try:
            self._fd = os.open(NODE, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise BridgeError(
                f"cannot be opened ({error.strerror})", str(NODE),
                "load the module (modprobe uinput), and run as root or as touchd-input.service",
            ) from error  # fmt: skip
        try:
            self._create(name, phys, keys, axes)
            name_at = bytearray(_NAME_BYTES)
            fcntl.ioctl(self._fd, UI_GET_SYSNAME, name_at)
            self._refuse_second(phys, bytes(name_at).split(b"\0")[0].decode())
        except OSError as error:
            self.close()
            raise BridgeError(f"makes no device ({error.strerror})", str(NODE), "see dmesg") from error
        except BridgeError:
            self.close()
            raise

    def write(self, frame: bytes) -> None:
        """Hand the kernel one frame of events, in one piece; raise BridgeError if it takes none."""
        try:
            os.write(self._fd, frame)
        except OSError as error:
            raise BridgeError(
                f"takes no events ({error.strerror})", str(NODE), "start it again, and see dmesg"
            ) from error

    def close(self) -> None:
        """Remove the device; further calls do nothing."""
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._fd, UI_DEV_DESTROY)
            os.close(self._fd)
            self._fd = -1

    def _create(self, name: str, phys: str, keys: Collection[int], axes: Collection[Axis]) -> None:
        fcntl.ioctl(self._fd, UI_SET_EVBIT, EV_KEY)
        for key in keys:
            fcntl.ioctl(self._fd, UI_SET_KEYBIT, key)
        fcntl.ioctl(self._fd, UI_SET_PHYS, phys.encode() + b"\0")
        if axes:
            fcntl.ioctl(self._fd, UI_SET_EVBIT, EV_ABS)
            fcntl.ioctl(self._fd, UI_SET_PROPBIT, INPUT_PROP_DIRECT)  # else it is a touchpad
        for code, least, most, per_mm in axes:  # struct uinput_abs_setup: code, value, range, fuzz, flat, resolution
            fcntl.ioctl(self._fd, UI_ABS_SETUP, struct.pack("@Hxxiiiiii", code, 0, least, most, 0, 0, per_mm))
        setup = struct.pack("@HHHH80sI", BUS_VIRTUAL, VENDOR_ID, PRODUCT_ID, VERSION, name.encode(), 0)
        fcntl.ioctl(self._fd, UI_DEV_SETUP, setup)
        fcntl.ioctl(self._fd, UI_DEV_CREATE)

    def _refuse_second(self, phys: str, own: str = "") -> None:
        """Raise BridgeError if another process has made the device; of two at once, the earlier one stays."""
        others = [number_of(name) for name in devices_at(phys) if name != own]
        if others and (not own or min(others) < number_of(own)):
            raise BridgeError("is there already: another `touchd input` runs", phys, "stop the other one")


def devices_at(phys: str) -> list[str]:
    """Return the names, `input7`, of the input devices that the kernel has at this place."""
    found = []
    for file in DEVICES.glob("input*/phys"):
        with contextlib.suppress(OSError):  # it went meanwhile
            if file.read_text(errors="replace").strip() == phys:
                found.append(file.parent.name)
    return found


def number_of(name: str) -> int:
    """Return the 7 of `input7`."""
    return int(name.removeprefix("input") or 0)


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


def _within(value: float, most: int) -> int:
    return round(min(max(value, 1.0), most))


def fingers_at(places: Mapping[int, Place]) -> dict[int, Finger]:
    """Return the fingers in the device's units."""
    fingers = {}
    for number, place in places.items():
        contact, size = place.contact, UNKNOWN_SIZE
        if contact.major_mm and contact.minor_mm:
            turned = round(place.angle_deg % 180.0 - 90.0)
            size = _within(contact.major_mm * PER_MM, SIZE_MAX), _within(contact.minor_mm * PER_MM, SIZE_MAX), turned
        pressure = _within(contact.force * PRESSURE_MAX, PRESSURE_MAX)
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
