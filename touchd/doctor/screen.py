"""Checks of `touchd doctor` on the touch screen: its mapping, the right to make it, udev, compositor and outputs."""

from __future__ import annotations

import os
from pathlib import Path

from touchd.bridges import uinput
from touchd.bridges.area import WORST_RMS_MM
from touchd.bridges.screen import connected, read
from touchd.config.schema import Settings
from touchd.doctor.checks import Finding, grade
from touchd.sinks.endpoint import SERVICE

UDEV = Path("/run/udev/data")
BUS = Path(SERVICE.removeprefix("ipc://"))
PROCESSES = Path("/proc")
COMPOSITORS = {
    "Xorg": "xinput map-to-output 'touchd screen' {output}, after each rotation",
    "weston": 'a udev rule with ENV{{WL_OUTPUT}}="{output}"',
    "sway": "input '4617:1:touchd_screen' map_to_output {output}",
    "labwc": '<touch deviceName="touchd screen" mapToOutput="{output}"/> in rc.xml',
    "cage": "no other output than the plate's",
    "kwin_wayland": "choose the output in the settings of the touch screen",
    "gnome-shell": "input.screen_mm within 5 % of that output's size",
}
"""What the kernel calls them, and what tells each on which of several outputs the touches are."""
_SEE = "to see it: sudo touchd doctor"
_MAP = "touchd map, with touches in the middle of each cross"


def check_screen(settings: Settings) -> list[Finding]:
    """Return what concerns the touch screen; nothing where no screen is configured or made."""
    found = uinput.devices_at(uinput.phys_of(settings.device.name))
    if not settings.input.screen_mm and not settings.input.keypad and not found:
        return []
    findings = [] if settings.input.keypad else [_mapping(settings), _compositor()]
    if found:
        return [*findings, _tagged(found[0])]
    findings.append(_permitted())
    if BUS.exists():
        findings.append(Finding("screen", "warning", "the daemon runs, and no touch screen is there",
                                "systemctl enable --now touchd-input; journalctl -u touchd-input"))  # fmt: skip
    return findings


def _mapping(settings: Settings) -> Finding:
    if not settings.input.screen_mm:
        return Finding("mapping", "failure", "input.screen_mm is not set", _MAP)
    x, y, wide, high = settings.input.screen_mm
    residual_mm = settings.input.residual_mm
    level = grade(residual_mm, (WORST_RMS_MM / 2, WORST_RMS_MM))
    text = f"{wide:g} x {high:g} mm at {x:g}, {y:g} mm of the plate, turned by {settings.input.rotate} degrees, "
    text += f"{residual_mm:.2f} mm off the touches that measured it" if residual_mm else "written by hand, not measured"
    return Finding("mapping", level, text, "" if level == "ok" else _MAP)


def _permitted() -> Finding:
    if not uinput.NODE.exists():
        return Finding("uinput", "failure", f"there is no {uinput.NODE}", "modprobe uinput; a kernel that has it")
    if not os.access(uinput.NODE, os.W_OK):
        return Finding("uinput", "warning", f"{uinput.NODE} may not be opened from here",
                       f"nothing, if touchd-input.service makes the screen; {_SEE}")  # fmt: skip
    return Finding("uinput", "ok", f"{uinput.NODE} may be opened")


def _tagged(name: str) -> Finding:
    """Check what udev has found the device to be: compositors go by it."""
    for file in (uinput.DEVICES / name).glob("event*/dev"):
        if {"E:ID_INPUT_TOUCHSCREEN=1", "E:ID_INPUT_KEY=1"} & {*read(UDEV / f"c{read(file)}").split("\n")}:
            return Finding("screen", "ok", f"{name} exists, tagged by udev: {file.parent.name}")
    return Finding("screen", "failure", f"{name} is there, and udev has not tagged it: no compositor takes it",
                   f"udevadm trigger --action=change /sys/class/input/{name}; is udev running?")  # fmt: skip


def _compositor() -> Finding:
    """Say which compositor takes the touches, and on which output it shows them."""
    names = sorted(COMPOSITORS.keys() & {read(file) for file in PROCESSES.glob("[0-9]*/comm")})
    outputs = [folder.name.split("-", 1)[1] for folder in connected()]
    hidden = not names and not (PROCESSES / "1").exists()  # as in touchd-web.service
    text = ", ".join(names) or ("not to be seen from here" if hidden else "none that touchd knows")
    text += f"; connected outputs: {', '.join(outputs) or 'none'}"
    if hidden:
        return Finding("compositor", "warning", text, _SEE)
    if not names:
        return Finding("compositor", "warning", text, f"start one of {', '.join(COMPOSITORS)}")
    if not outputs:
        return Finding("compositor", "warning", text, "connect the screen below the plate, and switch it on")
    if len(outputs) > 1:
        fix = "; ".join(f"{name}: {COMPOSITORS[name]}" for name in names).format(output=outputs[0])
        return Finding("compositor", "warning", f"{text}; one of them lies below the plate", fix)
    return Finding("compositor", "ok", text)
