"""`make vm-test`: the package in a machine of its own, with the kernel's USB, udev and systemd.

All is done in one boot, by `guest.sh`; the tests look at what was seen. The machine's processor is emulated, so times
in it mean nothing; behaviour does.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.processes import ROOT
from tests.system.usb.plate import write
from tests.system.usb.test_mocked_kernel import STEPS
from tests.system.vm.libinput import messages, same, seen, wanted, ways
from tests.system.vm.machine import Found, boot, handed_in, made

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def image() -> Path:
    """The machine, made once for each version of its recipe and kept."""
    return made("vm")


@pytest.fixture(scope="session")
def host(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What goes into the machine, and comes out of it."""
    folder = handed_in(
        tmp_path_factory.mktemp("host"),
        HERE / "guest.sh",
        HERE / "usbipdaq.py",
        HERE / "screenbus.py",
        ROOT / "tests/system/usb/client.py",
        ROOT / "tests/system/usb/player.py",
    )
    write(folder)
    return folder


@pytest.fixture(scope="session")
def found(image: Path, host: Path) -> Found:
    """What was seen in the machine."""
    logs = ("gadget.err", "usbip.err", "usbip.log", "screen.err", "screen.events", "ends.events", "plate.events")
    return boot(image, host, logs)


def test_the_package_installs_and_starts_nothing_without_a_device(found: Found) -> None:
    assert (found["installed"], found["before-plug"]) == ("0", "inactive")


def test_plugging_the_device_in_starts_the_daemon_as_a_user_of_its_own(found: Found) -> None:
    assert found["started-by-plug"] == "0"
    assert found["group"] == "touchd-dev 660"
    assert found["user"] not in ("", "root", "0")
    assert found["bus"] == "touchd-bus 660"


@pytest.mark.parametrize("bus", ["gadget", "usbip"])
def test_a_device_on_the_kernel_s_usb_lives_through_everything(found: Found, host: Path, bus: str) -> None:
    assert found[f"{bus}-scenario"] == "0"
    steps = (host / f"{bus}.steps").read_text()
    assert [step for step in STEPS if f'{{"step": "{step}"' in steps] == list(STEPS)


def test_killed_or_frozen_it_is_there_again_and_so_are_touches(found: Found) -> None:
    assert (found["killed-restarts"], found["killed-streams"]) == ("0", "0")
    assert (found["frozen-restarts"], found["frozen-said"], found["touched-again"]) == ("0", "1", "0")


def test_it_may_keep_the_processors_awake_while_touched(found: Found) -> None:
    assert found["keeps-awake"] == "0 touchd-dev 660"


def test_without_the_device_it_waits_and_a_stopped_one_is_started_by_plugging_in(found: Found) -> None:
    assert (found["lost"], found["lost-active"]) == ("0", "active")
    assert found["stopped"] == "success 0"
    assert found["replug-starts"] == "0"


def test_a_connection_that_breaks_without_a_word_costs_no_restart(found: Found) -> None:
    assert found["usbip-starts"] == "0"
    assert (found["pulled-lost"], found["pulled-streams"]) == ("0", "0 same-process")


def test_a_touch_screen_is_what_libinput_takes_it_for(found: Found, host: Path) -> None:
    """Shipped disabled; started, it is a touch screen of the right size, under a user of its own that has uinput; so it
    is after udev has started again."""
    assert found["screen-shipped"] == "disabled"
    assert found["screen-starts"] == "0"
    assert found["screen-node"] == "touchd-input 660"
    assert found["screen-user"] not in ("", "root", "0")
    assert int(found["screen-memory"]) < 40_000
    assert (found["screen-second"], found["udev-restarted"]) == ("92", "0")
    listed = (host / "screen.devices").read_text().split("Device: ")
    (screen,) = [device for device in listed if device.strip().startswith("touchd screen")]
    assert re.search(r"Capabilities: +touch", screen)
    assert re.search(r"Size: +200x200mm", screen)
    assert re.search(r"Calibration: +identity", screen)
    assert re.search(r"touchd screen .* size 200x200mm ntouches 5", (host / "screen.events").read_text())


def test_libinput_sees_what_the_bus_has(host: Path, found: Found) -> None:
    """Taps, a swipe, a pinch and five fingers: each frame in order, each place within a tenth of a millimetre."""
    assert found["screen-starts"] == "0"
    bus = wanted(messages((host / "screen.bus").read_text()))
    libinput = seen((host / "screen.events").read_text())
    assert len(libinput) == 29, "four taps of 2 frames, three ways of 7"
    assert len({event.slot for frame in libinput for event in frame}) == 5
    assert [frame for frame, other in zip(libinput, bus, strict=False) if not same(frame, other)] == []


def test_no_finger_stays_down(found: Found, host: Path) -> None:
    """Silence of the daemon lifts; a killed and a frozen bridge take the device with them, and are there again, and
    the finger that lay there all along presses nothing; a stopped one lifts first."""
    assert found["screen-silence"] == "0"
    assert found["screen-killed"] == "0"
    assert found["screen-frozen"] == "0 1"
    assert found["screen-stopped"] == "success"
    text = (host / "ends.events").read_text()
    course = re.findall(r"(TOUCH_DOWN|TOUCH_UP|TOUCH_CANCEL|DEVICE_ADDED|DEVICE_REMOVED)[^\n]*", text)
    own = course[course.index("TOUCH_DOWN") :]
    gone = ["DEVICE_REMOVED", "DEVICE_ADDED"]
    lifted = [kind.replace("TOUCH_CANCEL", "TOUCH_UP") for kind in own]
    tap = ["TOUCH_DOWN", "TOUCH_UP"]
    assert lifted == [*tap, *tap, *gone, *tap, *gone, *tap, "DEVICE_REMOVED"]


def test_touches_on_the_plate_reach_libinput(found: Found, host: Path) -> None:
    """From the DAQ on USB to libinput: whole touches, from down to up, as the bus had them and in its order.

    An emulated processor stands still for longer than the 0.3 s after which a bridge lifts: long strokes may be cut.
    """
    assert found["plate-heard"] == "0"
    bus = ways(wanted(messages((host / "plate.bus").read_text())))
    libinput = ways(seen((host / "plate.events").read_text()))
    at = 0
    whole = 0
    for way in bus:  # the session is played again and again: each is sought behind the one before
        found_at = next((n for n, other in enumerate(libinput[at:], at + 1) if same(way, other)), 0)
        at, whole = (found_at, whole + 1) if found_at else (at, whole)
    assert whole >= 2


def test_the_touch_screen_lives_and_ends_with_the_daemon(found: Found) -> None:
    """Enabled, it starts whenever the daemon does, by plugging in too, and stops with it."""
    assert found["screen-stops-too"] == "inactive"
    assert found["screen-starts-too"] == "0"


def test_the_package_removes_and_purges_cleanly(found: Found) -> None:
    assert found["removed"] == "0 not-found"
    assert found["purged"] == "0"
