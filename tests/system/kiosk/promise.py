"""`make promise-test`: from a bare plate to a page that hears touches, by the package and its commands alone.

All is done in one boot, by `promise.sh` and `promiseguest.py`. The kernel's loopback card stands for the audio
interface, and the twin behind it for the plate: only it knows where the fingers are.
"""

from __future__ import annotations

import json
import math
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.processes import ROOT
from tests.system.kiosk.promisehost import SCREEN_MM, on_screen, scenes, write
from tests.system.kiosk.scenario import HEIGHT_PX, WIDTH_PX, kinds, take_pictures, touches
from tests.system.vm.machine import Found, boot, handed_in, made

HERE = Path(__file__).parent
NEAR_MM = 1.0
LOGS = ("plate.log", "calibrate.out", "fingers.steps", "fingers.err", "pageserver.err", "weston.log", "chromium.out",
        "browser.steps", "browser.err", "page.log")  # fmt: skip
Steps = dict[str, list[list[Any]]]
"""By name what became of each step, in order."""


@pytest.fixture(scope="session")
def host(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What goes into the machine, and comes out of it."""
    files = [*(HERE / name for name in ("audioplate.py", "page.html", "pageserver.py")), ROOT / "deploy/audio.conf"]
    folder = handed_in(tmp_path_factory.mktemp("host"), HERE / "promise.sh", *files)
    package = folder / HERE.relative_to(ROOT)
    package.mkdir(parents=True)
    for name in ("promiseguest.py", "audioscenario.py"):
        shutil.copy(HERE / name, package)
    write(folder)
    return folder


@pytest.fixture(scope="session")
def found(host: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Found]:
    """What was seen in the machine."""
    monitor, ended = tmp_path_factory.mktemp("monitor") / "qmp", threading.Event()
    pictures = threading.Thread(target=take_pictures, args=(host, monitor, ended))
    pictures.start()
    options = ("-m", "2560", "-device", "virtio-vga,xres=1024,yres=768", "-qmp", f"unix:{monitor},server,nowait")
    try:
        yield boot(made("kiosk"), host, LOGS, *options, limit_s=7200)
    finally:
        ended.set()
        pictures.join()
        print(*host.glob("*.png"))


def steps(host: Path, name: str) -> Steps:
    told: Steps = {}
    for line in map(json.loads, (host / name).read_text().splitlines()):
        told.setdefault(line["step"], []).append(line["values"])
    return told


def test_a_plate_is_calibrated_on_a_terminal(found: Found, host: Path) -> None:
    """`touchd calibrate` takes frames of a daemon that has no model, and a subscriber then receives ten fingers."""
    assert (found["terminal-installed"], found["terminal-uncalibrated"]) == ("0", "0")
    assert (found["calibrated"], found["model"], found["fingers"]) == ("0", "0", "0")
    assert (host / "calibrate.out").read_text().splitlines()[-1]
    assert "\ngood: " in f"\n{(host / 'calibrate.out').read_text()}"
    ((touched, order, places_mm),) = steps(host, "fingers.steps")["fingers"]
    assert touched == [True] * 10
    assert order == list(range(1, 11))
    for at_mm, (place_mm,) in zip(places_mm, scenes()["fingers"], strict=True):
        assert math.dist(at_mm, place_mm) < NEAR_MM


@pytest.fixture(scope="session")
def seen(found: Found, host: Path) -> Steps:
    """What became of each step in the browser."""
    assert (found["page-installed"], found["page-uncalibrated"]) == ("0", "0")
    assert (found["services"], found["browser"], found["person"]) == ("0", "0", "0")
    return steps(host, "browser.steps")


def test_the_wizard_calibrates(seen: Steps) -> None:
    ((word, _),) = seen["verdict"]
    assert word == "Good"
    assert "in-use" in seen


def test_crosses_tell_where_the_screen_is(seen: Steps) -> None:
    """Fingers touch the plate where the page shows its crosses; the screen is found to a millimetre."""
    for (touched, shown, lifted), (place_mm,) in zip(seen["cross"], scenes()["crosses"], strict=True):
        assert touched
        assert lifted
        assert math.dist(on_screen(shown[0] / WIDTH_PX, shown[1] / HEIGHT_PX), place_mm) < 0.5
    ((screen_mm,),) = seen["screen"]
    assert json.loads(screen_mm) == pytest.approx(SCREEN_MM, abs=NEAR_MM)


@pytest.fixture(scope="session")
def heard(seen: Steps, host: Path) -> dict[str, list[dict[str, Any]]]:
    """The page's events of each scene."""
    assert set(seen) > set(MOVES)
    events: dict[str, list[dict[str, Any]]] = {}
    name = ""
    for event in map(json.loads, (host / "page.log").read_text().splitlines()):
        if event["kind"].startswith("scene "):
            name = event["kind"].removeprefix("scene ")
        else:
            events.setdefault(name, []).append(event)
    return events


MOVES = {"tap": 1, "swipe": 1, "pinch": 2}
"""Fingers of each scene."""


@pytest.mark.parametrize("scene", MOVES)
def test_a_page_hears_fingers_where_they_are(heard: dict[str, list[dict[str, Any]]], scene: str) -> None:
    """Each begins where its finger came down, keeps to the finger's way, and ends where it was lifted."""
    fingers = MOVES[scene]
    events = touches(heard[scene], "touchstart", "touchmove", "touchend", "touchcancel")
    assert sorted(kinds(heard[scene])) == ["touchend"] * fingers + ["touchstart"] * fingers
    assert max(event["down"] for event in events) == fingers
    ways = [list(way) for way in zip(*scenes()[scene], strict=True)]
    worst_mm = 0.0
    for number in {event["id"] for event in events}:
        own = [event for event in events if event["id"] == number]
        places_mm = [on_screen(event["x"] / WIDTH_PX, event["y"] / HEIGHT_PX) for event in own]
        way = min(ways, key=lambda way: math.dist(way[0], places_mm[0]))
        ways.remove(way)
        for at_mm in places_mm:
            worst_mm = max(worst_mm, min(math.dist(at_mm, place_mm) for place_mm in way))
        assert math.dist(places_mm[0], way[0]) < NEAR_MM
        assert math.dist(places_mm[-1], way[-1]) < NEAR_MM
    print(f"{scene}: at most {worst_mm:.2f} mm off")
    assert worst_mm < NEAR_MM
