"""`touchd input`: a touch screen of the kernel's, for every program of the desktop."""

from __future__ import annotations

from pathlib import Path

import click

from touchd.bridges import uinput
from touchd.bridges.area import Area
from touchd.bridges.screen import KEY_CODES, Keypad, Screen
from touchd.bridges.uinput import BTN_TOUCH
from touchd.cli.bridge import serve
from touchd.cli.options import bus_option, config_option
from touchd.config.apart import load_apart


@click.command()
@bus_option
@config_option
def command(address: str | None, config: Path | None) -> None:
    """Make a multi-touch screen of the kernel's, and show it the touches that a running daemon publishes.

    `[input]` in the configuration says where the screen lies on the plate: see `touchd map`. It takes the right to
    open /dev/uinput, which touchd-input.service has.
    """
    found = load_apart(config)
    phys = uinput.phys_of(found.device.name)
    if found.input.keypad:
        keypad = uinput.Device(uinput.KEYPAD_NAME, phys, sorted(set(KEY_CODES.values())))
        serve(address, found.input, Keypad(keypad), "a keypad")
        return
    area = Area(found.input)
    device = uinput.Device(uinput.SCREEN_NAME, phys, (BTN_TOUCH,), uinput.screen_axes(area.size_mm))
    serve(address, found.input, Screen(area, device), f"a touch screen of {area.size_mm[0]:g} x {area.size_mm[1]:g} mm")
