"""Where the screen lies on the plate, by touches at crosses that the page shows: what `touchd map` does."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from touchd.bridges.fit import LEAST_TOUCHES, Crosses, Mapping, Touched, fit, keys_of
from touchd.calibration.wizard.frames import Stopped, refuse_keypad
from touchd.client import Subscriber
from touchd.config.edit import set_keys
from touchd.config.load import load
from touchd.config.schema import InputSettings
from touchd.errors import BusTimeout, OutputError
from touchd.event import PlateEvent
from touchd.files import replacing

SILENT_S = 3.0
"""A daemon that runs says its health each second."""
_LOOK_S = 0.2
_TAKEN_S = 15.0
"""How long touchd-mapping.service may need."""


def take_crosses(
    address: str | None, stop: threading.Event, due: Callable[[Any], object], silent_s: float = SILENT_S
) -> list[Touched]:
    """Take a touch at each cross; `due` is called with the next one, for the page.

    While the daemon has said nothing for `silent_s` its `at` is None.

    Raises Stopped if `stop` was set; CalibrationError if the plate is a keypad.
    """
    crosses, shown, heard_s = Crosses(), None, time.monotonic()
    with Subscriber(address, ("touch", "plate", "health"), max_age_s=None) as events:
        while crosses.due:
            silent = time.monotonic() - heard_s > silent_s
            cross = {"number": len(crosses.taken) + 1, "of": LEAST_TOUCHES, "at": None if silent else crosses.due}
            if cross != shown:
                due(shown := cross)
            if stop.is_set():
                raise Stopped
            with contextlib.suppress(BusTimeout):
                event = events.receive(_LOOK_S)
                heard_s = time.monotonic()
                refuse_keypad(isinstance(event, PlateEvent) and bool(event.keys))
                crosses.feed(event)
    return crosses.taken


def keep(
    touched: Sequence[Touched], config: Path, handed: Path, *, writable: bool | None = None
) -> dict[str, Any] | None:
    """Fit the mapping, write it to the configuration, and return it as `shown` does.

    Where the configuration is root's, the touches are left at `handed`: touchd-mapping.service fits and writes them.

    Raises BridgeError if no mapping explains the touches; OutputError if nobody writes it.
    """
    mapping = fit(touched)
    if os.access(config.parent, os.W_OK) if writable is None else writable:
        set_keys(config, "input", keys_of(mapping))
    else:
        with replacing(handed) as file:
            file.write(json.dumps(touched).encode())
        _await(mapping, config, handed)
    return shown(load(config).input)


def shown(settings: InputSettings) -> dict[str, Any] | None:
    """Return where the screen lies, for the page; None where nobody knows."""
    if not settings.screen_mm:
        return None
    return {"screen_mm": list(settings.screen_mm), "rotate": settings.rotate, "residual_mm": settings.residual_mm}


def _await(mapping: Mapping, config: Path, handed: Path) -> None:
    until_s = time.monotonic() + _TAKEN_S
    while time.monotonic() < until_s:
        found = load(config if config.exists() else None).input
        if (tuple(found.screen_mm), found.rotate) == (mapping.screen_mm, mapping.rotate):
            return
        time.sleep(_LOOK_S)
    raise OutputError("nobody has written the mapping", str(config), f"as root: touchd map --from {handed}")
