"""`input.hold_off`: while the screen is dark nothing is touched, and nothing typed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.unit.bridges.events import MS, contact
from tests.unit.bridges.kernel import Kernel
from touchd.bridges import screen, uinput
from touchd.bridges.area import Area
from touchd.bridges.screen import HoldOff, Keypad, Screen
from touchd.config.schema import InputSettings
from touchd.event import KeyEvent


class Room:
    """A screen that is dark or light, and a bridge that is asked every 0.25 s."""

    def __init__(self) -> None:
        self.dark, self.now_ns = False, 0
        self.kernel = Kernel()
        area = Area(InputSettings(screen_mm=(0, 0, 200, 100)))
        self.bridge = HoldOff(Screen(area, self.kernel), lambda: self.dark)

    def see(self, *numbers: int) -> int:
        """Return how many of these fingers are down for the kernel, a beat later."""
        self.now_ns += 250 * MS
        self.bridge.idle(self.now_ns)
        self.bridge.show({number: contact(number) for number in numbers}, self.now_ns)
        return len(self.kernel.live)


def test_dark() -> None:
    """In the dark a finger lifts, and one that comes down counts neither then nor when it is light again."""
    room = Room()
    assert room.see(1) == 1
    room.dark = True
    room.bridge.idle(room.now_ns + 250 * MS)
    assert not room.kernel.live
    assert room.see(1, 2) == 0
    room.dark = False
    assert room.see(1, 2) == 0
    assert room.see(1, 2, 3) == 1
    assert room.see(2) == 0
    assert room.see(2, 4) == 1


def test_keypad() -> None:
    """In the dark no key is typed, and one that was held is released."""
    written: list[bytes] = []

    class Device(uinput.Device):
        def __init__(self) -> None:
            """It is not the kernel's."""

        def write(self, frame: bytes) -> None:
            written.append(frame)

        def close(self) -> None:
            """Nothing is open."""

    is_dark = False
    bridge = HoldOff(Keypad(Device()), lambda: is_dark)
    press, release = (KeyEvent("touchd", 1, 0, "", "5", phase, 1.0) for phase in ("press", "release"))
    for event in (press, release):
        bridge.press(event)
    assert len(written) == 2
    bridge.press(press)
    is_dark = True
    bridge.idle(250 * MS)
    assert len(written) == 4
    for event in (release, press, release):
        bridge.press(event)
    assert len(written) == 4


@pytest.mark.parametrize(
    ("dpms", "lights", "expected"),
    [
        ({}, [], False), ({"A": "On"}, [], False), ({"A": "Off"}, [], True), ({"A": "Off", "B": "On"}, [], False),
        ({"A": "Off", "none": "On"}, [], True), ({"A": "On"}, ["0"], False), ({"A": "On"}, ["4"], True),
        ({"A": "On"}, ["4", "0"], False),
    ],
)  # fmt: skip
def test_system(
    dpms: dict[str, str], lights: list[str], expected: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is dark when all connected screens are off, or all backlights."""
    monkeypatch.setattr(screen, "CONNECTORS", tmp_path / "drm")
    monkeypatch.setattr(screen, "BACKLIGHTS", tmp_path / "backlight")
    for name, value in dpms.items():
        folder = tmp_path / f"drm/card0-{name}"
        folder.mkdir(parents=True)
        (folder / "status").write_text("disconnected\n" if name == "none" else "connected\n")
        (folder / "dpms").write_text(value + "\n")
    for n, value in enumerate(lights):
        (tmp_path / f"backlight/{n}").mkdir(parents=True)
        (tmp_path / f"backlight/{n}/bl_power").write_text(value + "\n")
    assert screen.is_dark() is expected
