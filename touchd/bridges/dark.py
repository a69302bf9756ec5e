"""Holds touches off while the screen is dark: nobody sees what they would do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from touchd.bridges.bridge import Down, Output
from touchd.event import KeyEvent

CONNECTORS = Path("/sys/class/drm")
BACKLIGHTS = Path("/sys/class/backlight")
_LOOK_NS = 200_000_000
"""Whether it is dark is asked this often."""


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
