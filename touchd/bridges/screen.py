"""Shows the fingers on a touch screen of the kernel's, or the keys of a keypad as key codes.

While the screen is dark touches are held off: nobody sees what they would do.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from touchd.bridges import uinput
from touchd.bridges.area import Area
from touchd.bridges.bridge import Down, Output
from touchd.event import KeyEvent

CONNECTORS = Path("/sys/class/drm")
BACKLIGHTS = Path("/sys/class/backlight")
_LOOK_NS = 200_000_000
"""Whether it is dark is asked this often."""


class Screen(Output):
    """A touch screen: to the program below it a key is a touch, and the kernel keeps what was shown."""

    topics = ("touch", "health")

    def __init__(self, area: Area, device: uinput.Device) -> None:
        self._area, self._device = area, device
        self._slots: uinput.Slots = {}
        self._fingers: dict[int, uinput.Finger] = {}  # as written last

    def show(self, down: Down, t_ns: int) -> None:
        """Write one frame, unless all fingers are where they were, in the device's units."""
        fingers = uinput.fingers_at(self._area.places(down, t_ns))
        if fingers == self._fingers and fingers.keys() <= self._slots.keys():  # none waits for a slot
            return
        self._fingers = fingers
        frame, self._slots = uinput.encode(self._slots, fingers)
        self._device.write(frame)

    def close(self) -> None:
        """Lift all fingers and remove the device."""
        try:
            self._device.write(uinput.lift_all())
        finally:
            self._device.close()


KEY_ESC, KEY_BACKSPACE = 1, 14
_DIGITS = dict(zip("7894561230", (71, 72, 73, 75, 76, 77, 79, 80, 81, 82), strict=True))  # KEY_KP7 to KEY_KP0
KEY_CODES = {
    **_DIGITS, "*": 55, "+": 78, "-": 74, ".": 83, ",": 121, "/": 98, "=": 117, "#": 0x20B,
    "enter": 96, "ok": 96, "cancel": KEY_ESC, "clear": KEY_BACKSPACE, "c": KEY_BACKSPACE, "x": KEY_ESC,
}  # fmt: skip
"""Key codes of linux/input-event-codes.h by the name of a layout's key, in small letters."""


class Keypad(Output):
    """A keypad: the keys of `keypad.layout` as key codes. A key without a code is left out."""

    topics = ("touch", "key", "health")

    def __init__(self, device: uinput.Device) -> None:
        self._device = device
        self._held: set[int] = set()

    def show(self, down: Down, t_ns: int) -> None:  # noqa: ARG002 - only its emptiness matters
        """Release all keys if no finger is down."""
        if not down:
            for code in sorted(self._held):
                self._write(code, 0)
            self._held.clear()

    def press(self, event: KeyEvent) -> None:
        """Write a press or a release."""
        code = KEY_CODES.get(event.key.lower())
        if code is None or (event.phase == "press") == (code in self._held):
            return
        self._held ^= {code}
        self._write(code, int(event.phase == "press"))

    def close(self) -> None:
        """Release all keys and remove the device."""
        try:
            self.show({}, 0)
        finally:
            self._device.close()

    def _write(self, code: int, value: int) -> None:
        self._device.write(uinput.pack((uinput.EV_KEY, code, value), (uinput.EV_SYN, uinput.SYN_REPORT, 0)))


def read(file: Path) -> str:
    """Return what a small file of the kernel's holds; nothing if it is gone."""
    try:
        return file.read_text(errors="replace").strip()
    except OSError:
        return ""


def connected() -> list[Path]:
    """Return the folders of the connectors that have a screen, as /sys/class/drm/card0-HDMI-A-1."""
    return sorted(file.parent for file in CONNECTORS.glob("card*-*/status") if read(file) == "connected")


def is_dark() -> bool:
    """Return whether all connected screens are switched off (DPMS), or all backlights; False where none is known."""
    screens = [read(folder / "dpms") != "On" for folder in connected()]
    lights = [read(file) not in ("0", "") for file in BACKLIGHTS.glob("*/bl_power")]
    return any(known and all(known) for known in (screens, lights))


class HoldOff:
    """An output that shows nothing while it is dark: what is down lifts, and what comes down then never counts."""

    def __init__(self, output: Output, dark: Callable[[], bool] = is_dark) -> None:
        self._output, self._dark = output, dark
        self.topics = output.topics
        self._is_dark, self._looked_ns = False, 0
        self._down: Down = {}
        self._held_off: set[int] = set()

    def show(self, down: Down, t_ns: int) -> None:
        """Show the fingers that came down while it was light."""
        self._down = down
        self._held_off = down.keys() & (down.keys() if self._is_dark else self._held_off)
        self._output.show({number: contact for number, contact in down.items() if number not in self._held_off}, t_ns)

    def press(self, event: KeyEvent) -> None:
        """Show a key's press while it is light, and every release."""
        if not self._is_dark or event.phase == "release":
            self._output.press(event)

    def idle(self, now_ns: int) -> None:
        """Look whether it is dark."""
        if not 0 <= now_ns - self._looked_ns < _LOOK_NS:
            self._looked_ns, before = now_ns, self._is_dark
            self._is_dark = self._dark()
            if self._is_dark and not before:
                self.show(self._down, now_ns)
        self._output.idle(now_ns)

    def close(self) -> None:
        """Lift all and end."""
        self._output.close()
