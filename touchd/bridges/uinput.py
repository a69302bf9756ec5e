"""A touch screen or a keypad of the kernel's, made through /dev/uinput.

Source: Linux, Documentation/input/uinput.rst and linux/uinput.h. Whoever has /dev/uinput open can make a keyboard, and
type: nothing else than this module opens it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
from collections.abc import Collection
from pathlib import Path

from touchd.bridges import slots
from touchd.errors import BridgeError

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
    x, y = (round(length * slots.PER_MM) for length in size_mm)
    return [
        (slots.ABS_MT_SLOT, 0, slots.SLOTS - 1, 0),
        (slots.ABS_MT_TRACKING_ID, 0, 0xFFFF, 0),
        (slots.ABS_MT_POSITION_X, 0, x, slots.PER_MM),
        (slots.ABS_MT_POSITION_Y, 0, y, slots.PER_MM),
        (slots.ABS_MT_PRESSURE, 0, slots.PRESSURE_MAX, 0),  # a resolution would mean units per gram
        (slots.ABS_X, 0, x, slots.PER_MM),
        (slots.ABS_Y, 0, y, slots.PER_MM),
        (slots.ABS_PRESSURE, 0, slots.PRESSURE_MAX, 0),
        (slots.ABS_MT_TOUCH_MAJOR, 0, slots.SIZE_MAX, slots.PER_MM),
        (slots.ABS_MT_TOUCH_MINOR, 0, slots.SIZE_MAX, slots.PER_MM),
        (slots.ABS_MT_ORIENTATION, -90, 90, 0),
    ]


class Device:
    """An input device of the kernel's. It ends with `close`, or with this process, however that ends.

    Parameters
    ----------
    name : str
        Udev rules and compositors match it.
    phys : str
        Only one device of it may be there.
    keys : collection of int
        Codes of its keys and buttons.
    axes : collection of Axis
        A touch screen has some.

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
            self._refuse_second(phys, self._sysname())
        except OSError as error:
            self.close()
            raise BridgeError(f"makes no device ({error.strerror})", str(NODE), "see dmesg") from error
        except BridgeError:
            self.close()
            raise

    def write(self, frame: bytes) -> None:
        """Hand the kernel one frame of events, in one piece."""
        os.write(self._fd, frame)

    def close(self) -> None:
        """Remove the device; further calls do nothing."""
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._fd, UI_DEV_DESTROY)
            os.close(self._fd)
            self._fd = -1

    def _create(self, name: str, phys: str, keys: Collection[int], axes: Collection[Axis]) -> None:
        fcntl.ioctl(self._fd, UI_SET_EVBIT, slots.EV_KEY)
        for key in keys:
            fcntl.ioctl(self._fd, UI_SET_KEYBIT, key)
        fcntl.ioctl(self._fd, UI_SET_PHYS, phys.encode() + b"\0")
        if axes:
            fcntl.ioctl(self._fd, UI_SET_EVBIT, slots.EV_ABS)
            fcntl.ioctl(self._fd, UI_SET_PROPBIT, INPUT_PROP_DIRECT)  # else it is a touchpad
        for code, least, most, per_mm in axes:  # struct uinput_abs_setup: code, value, range, fuzz, flat, resolution
            fcntl.ioctl(self._fd, UI_ABS_SETUP, struct.pack("@Hxxiiiiii", code, 0, least, most, 0, 0, per_mm))
        setup = struct.pack("@HHHH80sI", BUS_VIRTUAL, VENDOR_ID, PRODUCT_ID, VERSION, name.encode(), 0)
        fcntl.ioctl(self._fd, UI_DEV_SETUP, setup)
        fcntl.ioctl(self._fd, UI_DEV_CREATE)

    def _sysname(self) -> str:
        name = bytearray(_NAME_BYTES)
        fcntl.ioctl(self._fd, UI_GET_SYSNAME, name)
        return bytes(name).split(b"\0")[0].decode()

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
            if file.read_text().strip() == phys:
                found.append(file.parent.name)
    return found


def number_of(name: str) -> int:
    """Return the 7 of `input7`."""
    return int(name.removeprefix("input") or 0)
