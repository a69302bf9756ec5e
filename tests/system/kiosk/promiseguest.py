"""The whole promise in the virtual machine: fingers on the plate, a person at the browser, and what came of both.

With `fingers` it puts down ten fingers, one after the other, and looks at what a subscriber receives; with `browser` it
goes through the wizard, and touches what the screen shows. Each prints a line of JSON for each step, with the machine's
clock. The kernel's loopback card stands for the audio interface, `audioplate.py`, which reads `/run/plate`, for the
plate.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import tomllib
import urllib.request
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from tests.system.kiosk.audioscenario import Message, Scenario

PATIENCE_S = 900.0
LOOK_S = 0.5
NEAR_PX = 2.0
PLATE = Path("/run/plate")
SCREEN = "http://127.0.0.1:8000/"
DEVTOOLS = "http://127.0.0.1:9222/json/list"
BUTTON = "[...document.querySelectorAll('button')].find(b => b.textContent.trim() === %s && b.offsetParent)"
MARK = "document.querySelector('.stage:not([hidden]) .mark:not([hidden])')"
WHAT = "document.querySelector('.stage .what').textContent"


def up_s() -> float:
    return float(Path("/proc/uptime").read_text().split()[0])


def step(name: str, *values: object) -> None:
    print(json.dumps({"step": name, "values": values, "up_s": round(up_s(), 1)}), flush=True)


def picture(name: str) -> None:
    """Have the host take a picture of the screen."""
    Path(f"picture-{name}").touch()
    taken = Path(f"picture-{name}.taken")
    until = time.monotonic() + PATIENCE_S
    while not taken.exists() and time.monotonic() < until:
        time.sleep(LOOK_S)


class Hand(Scenario):
    """Fingers on the plate, by the names of their scenes."""

    def __init__(self, address: str) -> None:
        self.scenes: dict[str, Message] = json.loads(Path("touches.json").read_text())
        super().__init__(address, [place for (place,) in self.scenes["fingers"]["places_mm"]])

    def steer(self, command: str) -> None:
        PLATE.write_text(f"{command}\n")

    def down(self, scene: str, number: int = 0) -> bool:
        """Put the fingers down where a scene begins, on a plate that is known; return whether they are found."""
        rested = self.rested()
        self.until(lambda: self.rested() > rested)
        places = self.scenes[scene]["places_mm"][number]
        self.steer(f"touch {self.scenes[scene]['first'] + number}")
        return self.until(lambda: len(self.touched) == len(places))

    def move(self, scene: str) -> bool:
        """Move them to where it ends; return whether they are found there."""
        first, places = self.scenes[scene]["first"], self.scenes[scene]["places_mm"]
        self.steer(f"way {first} {first + len(places) - 1}")
        return self.until(lambda: self.are_at(places[-1]))

    def lift(self) -> bool:
        self.steer("release")
        return self.until(lambda: not self.touched)

    def are_at(self, places_mm: list[list[float]]) -> bool:
        found = sorted((one["x_mm"], one["y_mm"]) for one in self.touched)
        return len(found) == len(places_mm) and all(
            abs(x - a) < 1.0 and abs(y - b) < 1.0 for (x, y), (a, b) in zip(found, sorted(places_mm), strict=True)
        )


class Browser:
    """Chromium, by its DevTools."""

    def __init__(self) -> None:
        with urllib.request.urlopen(DEVTOOLS) as answer:
            pages = [one for one in json.load(answer) if one["type"] == "page"]
        self._socket = connect(pages[0]["webSocketDebuggerUrl"], max_size=None, open_timeout=PATIENCE_S,
                               ping_interval=None)  # fmt: skip
        self._number = 0

    def call(self, method: str, **parameters: object) -> Message:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(PATIENCE_S))
            if answer.get("id") == self._number:
                return dict(answer["result"])

    def find(self, script: str) -> Any:
        """The value of an expression in the page."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def until(self, script: str, what: str = "") -> Any:
        """Wait for a true value of an expression."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            if value := self.find(script):
                return value
            time.sleep(LOOK_S)
        raise TimeoutError(what or script)

    def click(self, script: str) -> None:
        """Press the mouse in the middle of an element, once it is there."""
        x, y = self.until(
            f"(() => {{ const one = {script}; if (!one) return null; one.scrollIntoView({{ block: 'nearest' }});"
            " const r = one.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()",
            script,
        )
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            pressed = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **pressed)

    def press(self, text: str) -> None:
        """Click the button with a text."""
        self.click(BUTTON % json.dumps(text))

    def type(self, name: str, text: str) -> None:
        """Type into a field."""
        self.find(f"document.querySelector('[name=\"{name}\"]').select()")
        self.call("Input.insertText", text=text)


def fingers(address: str) -> None:
    """Find ten fingers."""
    hand = Hand(address)
    step("streaming", hand.state("streaming"))
    found = [hand.finger(number) for number in range(1, 11)]
    places = [[one["x_mm"], one["y_mm"]] for one in hand.contacts.values()]
    step("fingers", found, [hand.place(one) for one in hand.contacts.values()], places)


def measures() -> dict[str, str]:
    """What PLATE.toml says, by the wizard's fields."""
    said = tomllib.loads(Path("PLATE.toml").read_text())
    plate, discs = said["plate"], said["discs"]
    values = {name: plate[name] for name in ("width_mm", "height_mm", "thickness_mm")}
    values["diameter_mm"] = discs["diameter_mm"]
    values["emitter.x"], values["emitter.y"] = discs["emitter_mm"]
    for n, (x, y) in enumerate(discs["receivers_mm"]):
        values[f"receiver{n}.x"], values[f"receiver{n}.y"] = x, y
    return {name: f"{value:g}" for name, value in values.items()}


def calibrate(page: Browser) -> None:
    """Go through the wizard from the measures to a model in use."""
    page.click("[...document.querySelectorAll('#views a')].find(a => a.textContent.includes('Calibrate'))")
    page.until(f"Boolean({BUTTON % json.dumps('Save the measures')})")
    for name, value in measures().items():
        page.type(name, value)
    picture("measures")
    step("measures")
    page.press("Save the measures")
    page.press("Listen for ten seconds")
    page.until("document.querySelector('progress').value > 0.3")
    picture("untouched")
    step("untouched")
    page.until("document.querySelector('.steps [aria-current]').textContent.startsWith('3') &&"
               " document.querySelector('progress').value > 0.1")  # fmt: skip
    picture("fit")
    step("fit")
    word = page.until("document.querySelector('.fitted .word')?.offsetParent &&"
                      " document.querySelector('.fitted .word').textContent")  # fmt: skip
    page.until("[...document.querySelectorAll('.pictures img')].some(i => i.naturalWidth > 0)")
    time.sleep(3.0)  # the screen shows it later
    picture("verdict")
    step("verdict", word, page.find("document.querySelector('.fitted').innerText.slice(0, 200)"))
    page.press("Try this model")
    page.press("Keep this model")
    page.until("document.body.innerText.includes('In use: the fitted model.')")
    step("in-use")


def map_screen(page: Browser, hand: Hand) -> None:
    """Touch the crosses where the page shows them."""
    step("streaming", hand.state("streaming"))
    page.press("Next: the screen")
    page.press("Touch the crosses")
    for number in range(len(hand.scenes["crosses"]["places_mm"])):
        page.until(f"{MARK} && {WHAT}.includes('{number + 1}\\u00a0of')")
        shown = page.find(f"(r => [r.x + r.width / 2, r.y + r.height / 2])({MARK}.getBoundingClientRect())")
        found = hand.down("crosses", number)
        if number == 2:
            picture("crosses")
        time.sleep(1.0)
        step("cross", found, shown, hand.lift())
    said = page.until("document.querySelector('.mapped').offsetParent &&"
                      " /The screen is/.test(document.querySelector('.mapped').textContent) &&"
                      " document.querySelector('.mapped').textContent")  # fmt: skip
    picture("mapped")
    step("mapped", said)


def gestures(page: Browser, hand: Hand) -> None:
    """Tap, swipe and pinch on a page of somebody else."""
    page.call("Page.navigate", url=SCREEN)
    page.until("document.readyState === 'complete' && Boolean(document.querySelector('canvas'))")
    time.sleep(2.0)
    log = Path("page.log")
    for scene in ("tap", "swipe", "pinch"):
        with log.open("a") as file:
            file.write(json.dumps({"kind": f"scene {scene}"}) + "\n")
        found = [hand.down(scene)]
        time.sleep(1.0)
        if len(hand.scenes[scene]["places_mm"]) > 1:
            found.append(hand.move(scene))
            time.sleep(1.0)
        found.append(hand.lift())
        time.sleep(3.0)  # until the page has told all
        picture(scene)
        step(scene, found)


def browser(address: str) -> None:
    """From a daemon without a model to a page that hears touches."""
    hand, page = Hand(address), Browser()
    # A link that is followed before the page's script has run takes the place of the token in the address.
    page.until("document.body.innerText.includes('Uncalibrated')")
    time.sleep(3.0)  # the screen shows it later
    picture("uncalibrated")
    step("page")
    calibrate(page)
    map_screen(page, hand)
    subprocess.run(["systemctl", "enable", "--now", "--quiet", "touchd-input"], check=True)
    time.sleep(10.0)  # the compositor opens the new device
    step("screen", Path("/etc/touchd/touchd.toml").read_text().partition("screen_mm = ")[2].partition("\n")[0])
    gestures(page, hand)


if __name__ == "__main__":
    {"fingers": fingers, "browser": browser}[sys.argv[1]](sys.argv[2])
