"""Checks of `touchd doctor` on the DAQ's entries in sysfs: present, permitted, with touchd's interface."""

from __future__ import annotations

import grp
import os
from pathlib import Path

from touchd.bridges.screen import read
from touchd.config.schema import DeviceSettings
from touchd.doctor.checks import Finding
from touchd.sources.usb_protocol import INTERFACE_CLASS

SYSTEM = Path("/")
_INTERFACE, _ENDPOINT = 4, 5  # descriptor types, USB 2.0 table 9-5
_BULK_IN = (0x80, 0x02)
_HIGH_SPEED_MBIT_S = 480.0


def examine(settings: DeviceSettings, system: Path = SYSTEM) -> list[Finding]:
    """Check the DAQ by /sys and /dev below `system`, without opening it; the last finding fails if it is unusable."""
    ids = f"{settings.vendor_id:04x}:{settings.product_id:04x}"
    devices = sorted((system / "sys/bus/usb/devices").glob("*"))
    found = [device for device in devices if f"{read(device / 'idVendor')}:{read(device / 'idProduct')}" == ids]
    if not found:
        return [Finding("device", "failure", f"no device with the ids {ids} is plugged in",
                        "plug it in; check its cable and power; compare device.vendor_id and device.product_id with "
                        "lsusb")]  # fmt: skip
    if settings.serial:
        serials = [read(device / "serial") for device in found]
        found = [device for device in found if read(device / "serial") == settings.serial]
        if not found:
            return [Finding("device", "failure", f"{ids} has serial number {', '.join(map(repr, serials))}, "
                            f"not {settings.serial!r}", "correct device.serial")]  # fmt: skip
    device = found[0]
    bus, address = int(read(device / "busnum") or 0), int(read(device / "devnum") or 0)
    name = " ".join(filter(None, (read(device / "product"), read(device / "serial"))))
    text = f"{ids} {name} on bus {bus:03d} address {address:03d}"
    several = f"; {len(found)} such devices, touchd uses the first" if len(found) > 1 else ""
    findings = [
        Finding("device", "warning", text + several, "set device.serial") if several else Finding("device", "ok", text),
        check_permissions(system / f"dev/bus/usb/{bus:03d}/{address:03d}"),
    ]
    try:
        findings.append(check_descriptors((device / "descriptors").read_bytes(), read(device / "speed")))
    except OSError as error:
        findings.append(Finding("descriptors", "failure", f"cannot be read ({error.strerror})", "plug it in again"))
    return findings


def check_permissions(node: Path) -> Finding:
    """Check that this user may open the device node."""
    try:
        status = node.stat()
    except OSError as error:
        return Finding("permissions", "failure", f"{node}: {error.strerror}", "plug it in again")
    try:
        group = grp.getgrgid(status.st_gid).gr_name
    except KeyError:
        group = str(status.st_gid)
    text = f"{node} is of group {group}, mode {status.st_mode & 0o777:04o}"
    if os.access(node, os.R_OK | os.W_OK):
        return Finding("permissions", "ok", text)
    if group == "root":
        return Finding("permissions", "failure", f"{text}: you may not open it",
                       "install 60-touchd.rules, with these ids, and plug the device in again")  # fmt: skip
    return Finding(
        "permissions", "failure", f"{text}: you may not open it", f"join its group: usermod -aG {group} USER"
    )


def check_descriptors(descriptors: bytes, speed_mbit_s: str) -> Finding:
    """Find touchd's interface and its bulk IN endpoint in the device's descriptors."""
    here, found = False, False
    at = 0
    while at + 2 <= len(descriptors) and descriptors[at] >= 2:
        length, kind = descriptors[at], descriptors[at + 1]
        fields = descriptors[at : at + length]
        if kind == _INTERFACE and len(fields) >= 9:
            here = tuple(fields[5:8]) == INTERFACE_CLASS
        elif kind == _ENDPOINT and len(fields) >= 7:
            found |= here and (fields[2] & 0x80, fields[3] & 0x03) == _BULK_IN
        at += length
    if not found:
        return Finding("descriptors", "failure", "no interface of touchd's protocol with a bulk endpoint to the host",
                       "install firmware for protocol 1 on the DAQ: docs/usb-protocol.md")  # fmt: skip
    speed = float(speed_mbit_s) if speed_mbit_s.replace(".", "", 1).isdecimal() else 0.0
    text = f"interface of protocol 1, at {speed:g} Mbit/s"
    if speed < _HIGH_SPEED_MBIT_S:
        fix = "use a cable and a port for USB 2 (480 Mbit/s): 12 Mbit/s carry some 400 frames per second"
        return Finding("descriptors", "warning", text, fix)
    return Finding("descriptors", "ok", text)
