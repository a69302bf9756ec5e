"""What is asked of /dev/uinput is a touch screen, and there is one of it."""

from __future__ import annotations

import fcntl
import os
import re
import struct
from pathlib import Path

import pytest

from tests.needs import need
from touchd.bridges import uinput
from touchd.bridges.screen import KEY_CODES
from touchd.bridges.uinput import BTN_TOUCH, Device, screen_axes
from touchd.errors import BridgeError

Asked = list[tuple[int, object]]
HEADER = Path("/usr/include/linux/input-event-codes.h")
KEYS = {
    "*": "KPASTERISK", "+": "KPPLUS", "-": "KPMINUS", ".": "KPDOT", ",": "KPCOMMA", "/": "KPSLASH", "=": "KPEQUAL",
    "#": "NUMERIC_POUND", "enter": "KPENTER", "ok": "KPENTER", "cancel": "ESC", "x": "ESC", "clear": "BACKSPACE",
    "c": "BACKSPACE",
} | {str(n): f"KP{n}" for n in range(10)}  # fmt: skip


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Asked:
    """What is asked of the kernel, in order; it calls the device input99."""
    requests: Asked = []

    def ioctl(_fd: int, request: int, argument: object = 0) -> int:
        if request == uinput.UI_GET_SYSNAME:
            assert isinstance(argument, bytearray)
            argument[:8] = b"input99\0"
        requests.append((request, argument))
        return 0

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    monkeypatch.setattr(uinput, "NODE", Path(os.devnull))
    monkeypatch.setattr(uinput, "DEVICES", tmp_path)
    return requests


def screen() -> Device:
    return Device("touchd screen", "touchd/plate", (BTN_TOUCH,), screen_axes((160.0, 90.0)))


def test_a_touch_screen(asked: Asked) -> None:
    """A direct touch screen of the picture's size, five slots and 100 units a millimetre; the numbers are Linux's."""
    screen().close()
    axes = {}
    for request, argument in asked:
        if request == 0x401C5504:
            assert isinstance(argument, bytes)
            code, value, least, most, fuzz, flat, per_mm = struct.unpack("@Hxxiiiiii", argument)
            axes[code] = least, most, per_mm
            assert (value, fuzz, flat) == (0, 0, 0)
    x, y, pressure, length = (0, 16000, 100), (0, 9000, 100), (0, 1000, 0), (0, 10000, 100)
    assert axes == {
        0x2F: (0, 4, 0), 0x39: (0, 65535, 0), 0x35: x, 0x36: y, 0x3A: pressure, 0x00: x, 0x01: y, 0x18: pressure,
        0x30: length, 0x31: length, 0x34: (-90, 90, 0),
    }  # fmt: skip
    others = [(request, argument) for request, argument in asked if request != 0x401C5504]
    assert others == [
        (0x40045564, 1), (0x40045565, 0x14A), (0x4008556C, b"touchd/plate\0"), (0x40045564, 3), (0x4004556E, 1),
        (0x405C5503, struct.pack("@HHHH80sI", 6, 0x1209, 1, 1, b"touchd screen", 0)), (0x5501, 0),
        (0x8040552C, bytearray(b"input99".ljust(64, b"\0"))), (0x5502, 0),
    ]  # fmt: skip


@pytest.mark.usefixtures("asked")
def test_a_kernel_that_takes_no_events(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that the kernel has taken away is named, with what to do."""
    monkeypatch.setattr(uinput, "NODE", Path("/dev/full"))
    with pytest.raises(BridgeError, match=r"takes no events \(No space left on device\) -> start it again"):
        screen().write(uinput.lift_all())


@pytest.mark.parametrize(("other", "stays"), [("input7", False), ("input100", True)])
def test_two_at_once(asked: Asked, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: str, stays: bool) -> None:
    """Of two that start at the same time, the one that the kernel made first stays, and the other goes."""
    create = fcntl.ioctl

    def ioctl(fd: int, request: int, argument: object = 0) -> int:
        if request == uinput.UI_DEV_CREATE:
            (tmp_path / other).mkdir()
            (tmp_path / other / "phys").write_text("touchd/plate\n")
        return create(fd, request, argument)  # type: ignore[call-overload, no-any-return]  # the fixture's

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    if stays:
        screen().close()
    else:
        with pytest.raises(BridgeError, match="another `touchd input` runs"):
            screen()
    assert asked[-1] == (uinput.UI_DEV_DESTROY, 0)
    asked.clear()
    with pytest.raises(BridgeError):
        screen()
    assert asked == [], "a desktop sees no second one, not for a moment"


def test_codes() -> None:
    """Axes, buttons and the keys of a keypad have the numbers of Linux's own header."""
    need(HEADER.exists(), f"{HEADER} is missing: apt install linux-libc-dev")
    lines = re.findall(r"(?m)^#define (\w+)\s+(0x[0-9a-f]+|\d+)\b", HEADER.read_text())
    linux = {name: int(number, 0) for name, number in lines}
    ours = {name: number for name, number in vars(uinput).items() if name in linux}
    assert len(ours) == 17
    assert ours == {name: linux[name] for name in ours}
    assert {key: linux[f"KEY_{name}"] for key, name in KEYS.items()} == KEY_CODES
