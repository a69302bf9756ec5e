"""Lift a finger in three ways, a line of standard input each: `there`, `corner`, `outside` the screen."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from touchd.bridges import uinput

PLACES_MM = {"there": (60.0, 40.0), "corner": (200.0, 200.0), "outside": (-300.0, -300.0)}
PRESS_S = 0.1


def frame(before: uinput.Slots, *at_mm: float) -> tuple[bytes, uinput.Slots]:
    """Return the events of one finger there, or of none."""
    x, y = (round(length * uinput.PER_MM) for length in at_mm or (0.0, 0.0))
    return uinput.encode(before, {1: uinput.Finger(x, y, 500)} if at_mm else {})


device = uinput.Device("touchd probe", uinput.phys_of("probe"), (uinput.BTN_TOUCH,), uinput.screen_axes((200.0, 200.0)))
Path("probe.ready").touch()
for line in sys.stdin:
    held: uinput.Slots = {}
    for place in (PLACES_MM["there"], PLACES_MM[line.strip()], ()):
        events, held = frame(held, *place)
        device.write(events)
        time.sleep(PRESS_S)
device.close()
