"""`make kiosk-test`: the package's touch screen under Weston and Xorg, and its audio interface on a loopback card.

All is done in one boot, by `guest.sh`; the tests look at what a page in Chromium heard, and at what a subscriber did.
`KIOSK_PARTS="wayland turned"` tries these parts alone: the tests of the others fail then.
"""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from matplotlib.image import imread

from tests.processes import ROOT, environment
from tests.system.vm.machine import Found, boot, handed_in, made

HERE = Path(__file__).parent
Heard = dict[str, list[list[dict[str, Any]]]]
WIDTH_PX, HEIGHT_PX, PLATE_MM = 1024, 768, 200.0
NEAR_PX = 1.0
TAP_MM = 50.0, 60.0
RED = 1.0, 0.4, 0.4
"""How the page marks a touch's end."""


def take_pictures(host: Path, monitor: Path, ended: threading.Event) -> None:
    """Take the picture of the machine's screen that its script asks for, by QEMU's monitor."""
    while not ended.wait(0.5):
        for wish in (path for path in host.glob("picture-*") if path.suffix == ""):
            if (taken := wish.with_suffix(".taken")).exists():
                continue
            with socket.socket(socket.AF_UNIX) as connection, connection.makefile("rw") as lines:
                connection.connect(str(monitor))
                lines.readline()
                for command, arguments in (
                    ("qmp_capabilities", {}),
                    ("screendump", {"filename": str(wish.with_suffix(".png")), "format": "png"}),
                ):
                    print(json.dumps({"execute": command, "arguments": arguments}), file=lines, flush=True)
                    lines.readline()
            taken.touch()


@pytest.fixture(scope="session")
def host(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What goes into the machine, and comes out of it."""
    names = ("page.html", "pageserver.py", "kills.py", "offscreen.py", "audio.sh", "audioplate.py", "audioscenario.py")
    files = [*(HERE / name for name in names), ROOT / "tests/system/vm/screenbus.py", ROOT / "deploy/audio.conf"]
    host = handed_in(tmp_path_factory.mktemp("host"), HERE / "guest.sh", *files)
    parts = os.environ.get("KIOSK_PARTS", "kills wayland turned x11 audio").split()
    (host / "parts").write_text("".join(f"{part}\n" for part in parts))
    return host


@pytest.fixture(scope="session")
def found(host: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Found]:
    """What was seen in the machine."""
    monitor, ended = tmp_path_factory.mktemp("monitor") / "qmp", threading.Event()
    pictures = threading.Thread(target=take_pictures, args=(host, monitor, ended))
    pictures.start()
    options = ("-m", "2560", "-device", "virtio-vga,xres=1024,yres=768", "-qmp", f"unix:{monitor},server,nowait")
    logs = ("screen.err", "pageserver.err", "weston.log", "weston.out", "xorg.out", "chromium.out", "page.log",
            "probe.err", "audio.err", "audio.steps")  # fmt: skip
    # The model takes some minutes: the machine begins meanwhile.
    making = subprocess.Popen([sys.executable, "-m", "tests.system.kiosk.audiohost", host], cwd=ROOT, env=environment())
    try:
        yield boot(made("kiosk"), host, logs, *options, limit_s=5400)
    finally:
        making.kill()
        making.wait()
        ended.set()
        pictures.join()
        print(*host.glob("*.png"))


@pytest.fixture(scope="session")
def heard(found: Found, host: Path) -> Heard:
    """The page's events of each scene, `part scene` -> one list for each time that it was played."""
    scenes: Heard = {}
    part = ""
    events: list[dict[str, Any]] = []
    for event in map(json.loads, (host / "page.log").read_text().splitlines()):
        kind = event["kind"]
        if kind.startswith("begin "):
            part = kind.removeprefix("begin ")
        elif kind.startswith("scene "):
            scenes.setdefault(f"{part} {kind.removeprefix('scene ')}", []).append(events := [])
        else:
            events.append(event)
    assert found["installed"] == "0"
    return scenes


def touches(events: list[dict[str, Any]], *kinds: str) -> list[dict[str, Any]]:
    return [event for event in events if event["kind"] in (kinds or ("touchstart", "touchend", "touchcancel"))]


def kinds(events: list[dict[str, Any]]) -> list[str]:
    return [event["kind"] for event in touches(events)]


def px(x_mm: float, y_mm: float) -> tuple[float, float]:
    """Where a finger lies on the screen, which is as large as the plate."""
    return x_mm / PLATE_MM * WIDTH_PX, y_mm / PLATE_MM * HEIGHT_PX


def off_px(event: dict[str, Any], x_px: float, y_px: float) -> float:
    return float(max(abs(event["x"] - x_px), abs(event["y"] - y_px)))


def is_at(event: dict[str, Any], x_mm: float, y_mm: float) -> bool:
    """Whether an event lies where the finger lay."""
    return off_px(event, *px(x_mm, y_mm)) <= NEAR_PX


def test_no_slot_is_stuck_after_a_hundred_kills(found: Found, host: Path) -> None:
    """Killed with fingers down, the device goes, and libinput has cancelled each touch before; the next device's
    touches begin and end like any."""
    assert (found["screen-starts"], found["kills"]) == ("0", "0")
    said = json.loads((host / "kills.json").read_text())
    assert len(said["held"]) == 100
    assert sum(fingers > 0 for fingers in said["held"]) >= 70
    assert not said["left"]
    down: set[str] = set()
    counted = Counter[str]()
    events = (host / "kills.events").read_text()
    course = r"TOUCH_(DOWN|UP|CANCEL)\s+\S+\s+(\d+) \(\d+\)|DEVICE_(ADDED|REMOVED)\s+touchd screen"
    for touch, slot, device in re.findall(course, events):
        counted[touch or device] += 1
        if touch == "DOWN":
            assert slot not in down
            down.add(slot)
        elif touch:
            down.remove(slot)
        else:
            assert not down
    assert counted["ADDED"] == counted["REMOVED"] > 75, "a device that goes at once libinput need not see"
    assert counted["CANCEL"] >= 70
    print("kills:", Counter(said["held"]), counted)


@pytest.mark.parametrize("desk", ["weston", "xorg"])
def test_a_page_hears_touches_where_the_finger_is(found: Found, heard: Heard, desk: str) -> None:
    """A tap is a start, an end and a click there; a swipe moves from one end to the other; a pinch has two fingers."""
    assert (found["screen-starts"], found[f"{desk}-page"]) == ("0", "0")
    (tap,) = heard[f"{desk} tap"]
    assert kinds(tap) == ["touchstart", "touchend"]
    assert all(is_at(event, *TAP_MM) for event in touches(tap))
    pointers = [(event["kind"], event["type"]) for event in touches(tap, "pointerdown", "pointerup", "click")]
    assert pointers == [(kind, "touch") for kind in ("pointerdown", "pointerup", "click")]
    (swipe,) = heard[f"{desk} swipe"]
    assert is_at(touches(swipe)[0], 20, 100)
    assert is_at(touches(swipe)[-1], 180, 100.37)
    assert kinds(swipe) == ["touchstart", "touchend"]
    assert touches(swipe, "touchmove")
    (pinch,) = heard[f"{desk} pinch"]
    assert max(event["down"] for event in touches(pinch)) == 2
    assert sorted(kinds(pinch)) == ["touchend"] * 2 + ["touchstart"] * 2


@pytest.mark.parametrize("desk", ["weston", "xorg"])
def test_a_page_hears_five_fingers(heard: Heard, desk: str) -> None:
    (five,) = heard[f"{desk} five"]
    starts = touches(five, "touchstart")
    assert max(event["down"] for event in starts) == 5
    assert all(any(is_at(event, 20 + 40 * n, 30 + 10 * n) for event in starts) for n in range(5))
    assert kinds(five).count("touchend") == 5


def test_weston_cancels_the_touch_of_a_killed_bridge(found: Found, heard: Heard) -> None:
    """Nothing is pressed, and the next tap is one."""
    assert found["weston-killed"] == "0"
    (killed,) = heard["weston weston-killed"]
    assert kinds(killed) == ["touchstart", "touchcancel"]
    assert len(touches(killed, "pointercancel")) == 1
    assert not touches(killed, "click")
    (tap,) = heard["weston tap after"]
    assert kinds(tap) == ["touchstart", "touchend"]


def test_x11_takes_a_killed_bridge_for_a_lifted_finger(found: Found, heard: Heard) -> None:
    """Why kiosks should use Wayland."""
    assert found["xorg-killed"] == "0"
    (killed,) = heard["xorg-killed xorg-killed"]
    assert kinds(killed)[0] == "touchstart"
    assert kinds(killed)[-1] in ("touchend", "touchcancel")


def test_a_stopped_bridge_lifts_first(found: Found, heard: Heard) -> None:
    assert found["xorg-stopped"] == "success"
    (stopped,) = heard["xorg-killed stopped"]
    assert kinds(stopped) == ["touchstart", "touchend"]


@pytest.mark.parametrize("place", ["there", "corner", "outside"])
def test_x11_cancels_no_touch_that_leaves_the_screen(found: Found, heard: Heard, place: str) -> None:
    """Why a bridge that loses the daemon lifts where the finger was."""
    assert found["probe"] == "0"
    (lifted,) = heard[f"xorg-killed lifted {place}"]
    print(f"lifted {place}:", [(event["kind"], event["x"], event["y"]) for event in lifted])
    assert "touchcancel" not in kinds(lifted)
    assert bool(touches(lifted, "click")) == (place == "there")


@pytest.mark.parametrize(("scene", "page"), [("turned tap", "turned-page"), ("xorg-turned tap mapped", "xorg-page")])
def test_touches_follow_a_turned_picture(found: Found, heard: Heard, scene: str, page: str) -> None:
    """Weston turns the touches with the picture, and X11 does after `xinput map-to-output`.

    Counter-clockwise: the picture's top is at the screen's left, its left at the screen's bottom.
    """
    assert found[page] == "0"
    (tap,) = heard[scene]
    assert kinds(tap) == ["touchstart", "touchend"]
    across_px, down_px = px(*TAP_MM)
    assert all(off_px(event, HEIGHT_PX - down_px, across_px) <= NEAR_PX for event in touches(tap))
    print(f"{scene}:", touches(tap)[0])


@pytest.mark.parametrize("picture", ["weston", "turned", "xorg"])
def test_the_mark_of_a_tap_lies_below_the_finger(found: Found, host: Path, picture: str) -> None:
    """On the screen, whichever way the picture is turned."""
    assert found[f"{picture}-page"] == "0"
    across_px, down_px = px(*TAP_MM)
    seen = imread(host / f"picture-{picture}.png")
    assert seen[round(down_px), round(across_px), :3] == pytest.approx(RED, abs=0.02)


def test_doctor_sees_the_screen(found: Found, host: Path) -> None:
    """Mapping, compositor with its output, and the device that udev has tagged."""
    assert found["weston-killed"] == "0"
    said = (host / "doctor.txt").read_text()
    for finding in (
        r"ok +mapping +200 x 200 mm at 0, 0 mm", r"ok +compositor +weston; connected outputs: Virtual-1$",
        r"ok +screen +input\d+ exists, tagged by udev: event\d+$",
    ):  # fmt: skip
        (line,) = re.findall(rf"(?m)^{finding}.*", said)
        print("doctor:", line)


@pytest.fixture(scope="session")
def steps(found: Found, host: Path) -> dict[str, list[Any]]:
    """What became of each step with the audio interface."""
    assert found["audio-scenario"] == "0"
    lines = map(json.loads, (host / "audio.steps").read_text().splitlines())
    return {line["step"]: line["values"] for line in lines}


def test_an_audio_interface_finds_fingers(steps: dict[str, list[Any]]) -> None:
    """From ALSA to the subscriber: ten fingers on the plate behind the kernel's loopback card, no more, in order."""
    assert steps["streams"] == [True]
    touched, order = steps["fingers"]
    assert touched == [True] * 10
    assert order == list(range(1, 11))


def test_an_audio_interface_is_lost_and_found(steps: dict[str, list[Any]]) -> None:
    """A process that stood still counts its xruns, a card that goes is told and awaited, each start finds another
    delay, and a card at another rate is refused with its rate."""
    assert steps["xrun"] == [True, True, True]
    assert steps["unplugged"][0]
    assert steps["plugged"] == [True, True, True]
    assert steps["restarted"] == [True, True, True]
    (delays,) = steps["delays"]
    assert len(delays) >= 4, "start, xrun, plug, restart"
    assert len(set(delays)) > 1
    assert steps["rate"] == [True]
