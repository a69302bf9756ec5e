"""What is said of the DAQ before it is opened, from a /sys and /dev made for it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.config.schema import DeviceSettings
from touchd.doctor.host import check_descriptors, check_permissions, examine
from touchd.sources.usb_protocol import INTERFACE_CLASS

DEVICE = bytes([18, 1, 0, 2, 255, 0, 0, 64, 9, 18, 1, 0, 0, 1, 1, 2, 3, 1])
CONFIGURATION = bytes([9, 2, 25, 0, 1, 1, 0, 128, 50])
INTERFACE = bytes([9, 4, 0, 0, 1, *INTERFACE_CLASS, 0])
ENDPOINT = bytes([7, 5, 0x81, 2, 0, 2, 0])
GOOD = DEVICE + CONFIGURATION + INTERFACE + ENDPOINT


def plug(system: Path, name: str = "1-1", descriptors: bytes = GOOD, **attributes: str) -> Path:
    """Put a device into the system; returns its node."""
    values = {
        "idVendor": "1209", "idProduct": "0001", "serial": "SN0001", "product": "DAQ", "busnum": "1", "devnum": "4",
        "speed": "480", **attributes,
    }  # fmt: skip
    folder = system / "sys/bus/usb/devices" / name
    folder.mkdir(parents=True)
    for key, value in values.items():
        (folder / key).write_text(value + "\n")
    (folder / "descriptors").write_bytes(descriptors)
    node = system / f"dev/bus/usb/{int(values['busnum']):03d}/{int(values['devnum']):03d}"
    node.parent.mkdir(parents=True, exist_ok=True)
    node.touch(mode=0o660)
    return node


def levels(system: Path, **settings: str) -> list[tuple[str, str]]:
    findings = examine(DeviceSettings.model_validate(settings), system)
    for finding in findings:
        assert (finding.fix == "") == (finding.level == "ok"), finding
    return [(finding.check, finding.level) for finding in findings]


def test_a_good_device_is_ok_in_every_line(tmp_path: Path) -> None:
    plug(tmp_path)
    assert levels(tmp_path) == [("device", "ok"), ("permissions", "ok"), ("descriptors", "ok")]


def test_no_device_and_no_usb_at_all_are_a_failure(tmp_path: Path) -> None:
    assert levels(tmp_path) == [("device", "failure")]
    plug(tmp_path, idProduct="0002")
    assert levels(tmp_path) == [("device", "failure")]


def test_of_several_the_serial_number_decides(tmp_path: Path) -> None:
    plug(tmp_path, "1-1", serial="A", devnum="4")
    plug(tmp_path, "1-2", serial="B", devnum="5")
    assert levels(tmp_path)[0] == ("device", "warning")
    assert levels(tmp_path, serial="B")[0] == ("device", "ok")
    assert "address 005" in examine(DeviceSettings(serial="B"), tmp_path)[0].text
    (missing,) = examine(DeviceSettings(serial="C"), tmp_path)
    assert missing.level == "failure"
    assert "'A', 'B'" in missing.text


def test_a_device_commands_no_terminal(tmp_path: Path) -> None:
    """What a device says of itself is printed without control characters."""
    plug(tmp_path, product="D\x1b[2JAQ", serial="\x9b0m7")
    assert examine(DeviceSettings(), tmp_path)[0].text == "1209:0001 D?[2JAQ ?0m7 on bus 001 address 004"


def test_a_node_that_is_not_there_fails(tmp_path: Path) -> None:
    plug(tmp_path).unlink()
    assert levels(tmp_path)[1] == ("permissions", "failure")


def test_a_damaged_entry_is_a_finding(tmp_path: Path) -> None:
    """A device that goes while it is looked at, or whose entry is damaged, ends no examination."""
    entry = plug(tmp_path).parents[4] / "sys/bus/usb/devices/1-1"
    (entry / "busnum").write_bytes(b"\xff\n")
    (entry / "devnum").unlink()
    assert levels(tmp_path) == [("device", "ok"), ("permissions", "failure"), ("descriptors", "ok")]


def test_a_node_that_may_not_be_opened_fails_and_the_fix_names_its_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = plug(tmp_path)
    monkeypatch.setattr(os, "access", lambda _path, _mode: False)
    finding = check_permissions(node)
    assert finding.level == "failure"
    # Of root's group no rule has been applied; of any other, its members may open it.
    assert ("60-touchd.rules" in finding.fix) == (node.stat().st_gid == 0)


@pytest.mark.parametrize(
    "descriptors",
    [
        DEVICE + CONFIGURATION + INTERFACE,
        DEVICE + CONFIGURATION + ENDPOINT,
        GOOD[:-5],
        DEVICE + CONFIGURATION + INTERFACE + bytes([7, 5, 0x01, 2, 0, 2, 0]),
        DEVICE + CONFIGURATION + INTERFACE + bytes([7, 5, 0x81, 3, 0, 2, 0]),
        DEVICE + CONFIGURATION + bytes([9, 4, 0, 0, 1, 3, 0, 0, 0]) + ENDPOINT,
        b"",
    ],
    ids=["no endpoint", "no interface", "cut off", "endpoint from the host", "interrupts", "a keyboard", "nothing"],
)
def test_descriptors_without_the_protocol_s_interface_fail(descriptors: bytes) -> None:
    assert check_descriptors(descriptors, "480").level == "failure"


def test_a_slow_port_is_a_warning() -> None:
    assert check_descriptors(GOOD, "12").level == "warning"
    assert check_descriptors(GOOD, "").level == "warning"
    assert check_descriptors(GOOD, "5000").level == "ok"


@given(st.binary(max_size=200), st.text(max_size=5))
def test_no_bytes_break_it(descriptors: bytes, speed: str) -> None:
    assert check_descriptors(descriptors, speed).level in ("ok", "warning", "failure")


@given(st.binary(max_size=60))
def test_what_follows_a_good_interface_does_not_hide_it(rest: bytes) -> None:
    assert check_descriptors(GOOD + rest, "480").level == "ok"
