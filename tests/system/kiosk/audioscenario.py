"""An audio interface's life in the virtual machine, as a subscriber sees it: prints a line of JSON for each step.

The kernel's loopback card stands for the interface, `audioplate.py` for the plate. Counts and order are judged, never
times.
"""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq

Message = dict[str, Any]
PATIENCE_S = 300.0
NEAR_MM = 3.0
CONFIG = Path("/etc/touchd/touchd.toml")
UNBIND = "/sys/bus/platform/drivers/snd_aloop/unbind"


class Scenario:
    """Steers the plate, and follows what the daemon says."""

    def __init__(self, address: str, places_mm: list[list[float]]) -> None:
        self.places_mm = places_mm
        self.contacts: dict[int, Message] = {}
        """Every contact of this daemon as it was last, by id."""
        self.touched: list[Message] = []
        self.health: Message = {}
        self._plate = subprocess.Popen(["true"], stdin=subprocess.PIPE, text=True)
        self._socket: Any = zmq.Context.instance().socket(zmq.SUB)
        for topic in (b"touch", b"health"):
            self._socket.setsockopt(zmq.SUBSCRIBE, topic)
        self._socket.connect(address)

    def plug(self) -> None:
        """Load the card, and put the plate on it."""
        subprocess.run(["modprobe", "snd-aloop", "pcm_substreams=1"], check=True)
        command = ["nice", "-n", "-19", sys.executable, "-B", "audioplate.py", "audio.npz"]
        self._plate = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=sys.stderr, text=True)

    def unplug(self) -> None:
        """Take the card away under those who use it, and the module with it."""
        with open(UNBIND, "w") as driver:
            driver.write("snd_aloop.0")  # returns once nobody holds the card
        self._plate.wait()
        subprocess.run(["rmmod", "snd-aloop"], check=True)

    def steer(self, command: str) -> None:
        assert self._plate.stdin is not None
        self._plate.stdin.write(f"{command}\n")
        self._plate.stdin.flush()

    def until(self, done: Callable[[], bool]) -> bool:
        """Listen until something is so; return whether it came to be."""
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            if self._socket.poll(200):
                topic, payload = self._socket.recv_multipart()
                message = json.loads(payload)
                if topic == b"health":
                    self.health = message
                else:
                    self.touched = [one for one in message["contacts"] if one["phase"] != "up"]
                    self.contacts |= {one["id"]: one for one in self.touched}
            if done():
                return True
        return False

    def state(self, state: str) -> bool:
        return self.until(lambda: self.health.get("state") == state)

    def finger(self, number: int) -> bool:
        """Whether one finger is found where it is, and lifted."""
        rested = self.rested()
        self.until(lambda: self.rested() > rested)  # while it learns the plate, a finger would be part of it
        self.steer(f"touch {number}")
        found = self.until(lambda: [self.place(one) for one in self.touched] == [number])
        self.steer("release")
        return self.until(lambda: not self.touched) and found

    def rested(self) -> int:
        """How many frames were those of a plate that is known, and not touched."""
        return int(self.health.get("skipped", {}).get("gate", 0))

    def place(self, contact: Message) -> int:
        """The number of the finger that lies where a contact is; 0 if none does."""
        off_mm = [math.dist((contact["x_mm"], contact["y_mm"]), place) for place in self.places_mm]
        return off_mm.index(min(off_mm)) + 1 if min(off_mm) < NEAR_MM else 0


def pid() -> int:
    shown = subprocess.run(["systemctl", "show", "touchd", "-p", "MainPID", "--value"], capture_output=True, text=True)
    return int(shown.stdout)


def delays() -> list[int]:
    """The delay from playback to capture that each start found, samples."""
    said = subprocess.run(["journalctl", "-u", "touchd", "-o", "cat", "--no-pager"], capture_output=True, text=True)
    return [int(found) for found in re.findall(r'"samples": (\d+),.*"delay found"', said.stdout)]


def main(address: str, places: str) -> None:
    began = time.monotonic()

    def step(name: str, *values: object) -> None:
        print(json.dumps({"step": name, "values": values, "s": round(time.monotonic() - began, 1)}), flush=True)

    plate = Scenario(address, json.loads(places))
    plate.plug()
    step("streams", plate.state("streaming"))
    touched = [plate.finger(number) for number in range(1, len(plate.places_mm) + 1)]
    step("fingers", touched, [plate.place(one) for one in plate.contacts.values()])
    process = pid()
    os.kill(process, signal.SIGSTOP)
    time.sleep(1.5)
    os.kill(process, signal.SIGCONT)
    counted = plate.until(lambda: plate.health.get("skipped", {}).get("xrun", 0) > 0)
    step("xrun", counted, plate.finger(1), pid() == process)
    plate.unplug()
    step("unplugged", plate.state("lost"), plate.health.get("reason"))
    plate.plug()
    step("plugged", plate.state("streaming"), plate.finger(2), pid() == process)
    subprocess.run(["systemctl", "restart", "--no-block", "touchd"], check=True)
    another = plate.until(lambda: pid() not in (0, process))
    plate.health = {}
    step("restarted", another, plate.state("streaming"), plate.finger(3))
    h = plate.health
    step("counts", h["frames"], h["lost"], h["corrupt"], h["clipped"], h["skipped"])
    step("delays", delays())
    config = CONFIG.read_text()
    CONFIG.write_text(config.replace("= 48000", "= 96000").replace("audio.onnx", "none.onnx"))
    subprocess.run(["systemctl", "restart", "--no-block", "touchd"], check=True)
    step("rate", plate.until(lambda: "takes 48000 samples a second, not 96000" in (plate.health.get("reason") or "")))


if __name__ == "__main__":
    main(*sys.argv[1:])
