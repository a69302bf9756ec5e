"""The life of a device as a subscriber sees it: the same scenario on a bus in memory, a mocked kernel and a real one.

As a program, `python client.py ADDRESS`, it prints commands for whoever holds the device, one a line with `!` before
it, and a line of JSON for each step; exit status 0 if all went as promised. It needs pyzmq and nothing of touchd.

The commands are `touch` and `release` (the frames show a finger from now on, or none; where the device plays a
recording over and over they can be ignored), `plug`, `unplug`, and those of `touchd gadget`: `corrupt`, `short`,
`halt`, `silent` and `normal`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import zmq

Message = dict[str, Any]
LIFT_MS = 100.0
TRIES = 10


class Failed(Exception):
    """The daemon did not do what it promises."""


class Scenario:
    """Steers a device, and checks what the daemon says of it.

    Parameters
    ----------
    address : str
        Of the daemon's bus.
    steer : callable
        Carries out a command on the device.
    patience_s : float
        How long any step may take.
    lift_ms : float
        How long fingers may stay down after the device is lost; to be raised where time means nothing.
    """

    def __init__(
        self, address: str, steer: Callable[[str], None], patience_s: float = 60.0, lift_ms: float = LIFT_MS
    ) -> None:
        self.steps: list[Message] = []
        self.touched: dict[int, Message] = {}
        """Contacts that are down, by id."""
        self.health: Message = {}
        self._steer = steer
        self._patience_s = patience_s
        self._lift_ms = lift_ms
        self._socket: Any = zmq.Context.instance().socket(zmq.SUB)
        for topic in (b"touch", b"health"):
            self._socket.setsockopt(zmq.SUBSCRIBE, topic)
        self._socket.connect(address)

    def run(self) -> None:
        """Go through all steps; raises Failed at the first broken promise."""
        try:
            for step in (self.begins, self.is_touched, self.is_unplugged, self.comes_back, self.survives_faults,
                         self.falls_silent, self.is_touched_again):  # fmt: skip
                step()
        finally:
            self.close()

    def close(self) -> None:
        """Stop listening."""
        self._socket.close(0)

    def waits_for(self, state: str) -> None:
        """The daemon says that it is in a state."""
        self._wait(f"state {state}", lambda: self.health.get("state") == state)

    def begins(self) -> None:
        """Frames flow."""
        self.waits_for("streaming")
        self._grows("frames", 40)  # the untouched plate is learned
        self._done("streaming")

    def is_touched(self) -> None:
        """A finger goes down."""
        self._steer("touch")
        self._wait("a finger", lambda: self.touched)
        self._done("touched", contacts=len(self.touched))

    def is_lifted(self) -> None:
        """All fingers are up."""
        self._wait("the finger's up", lambda: not self.touched)

    def is_unplugged(self) -> None:
        """Within 100 ms of the loss of the device all fingers are up, and health says lost."""
        up_ms = self._pull()
        for _ in range(TRIES - 1):
            if up_ms <= self._lift_ms:
                break
            # A computer that is busy with something else is late now and then, but not always.
            self._plug()
            self._steer("touch")
            self._wait("a finger", lambda: self.touched)
            up_ms = min(up_ms, self._pull())
        if up_ms > self._lift_ms:
            raise Failed(f"fingers are up after {up_ms} ms, not {self._lift_ms}")
        if not self.health.get("reason"):
            raise Failed("health says lost, but not why")
        self._done("unplugged", up_ms=up_ms)

    def comes_back(self) -> None:
        """The device is found again."""
        self._plug()
        self._done("replugged")

    def _pull(self) -> int:
        pulled = time.monotonic()
        self._steer("unplug")
        self.is_lifted()
        up_ms = round((time.monotonic() - pulled) * 1000)
        self.waits_for("lost")
        return up_ms

    def _plug(self) -> None:
        self._steer("release")
        self._steer("plug")
        self.waits_for("streaming")
        self._grows("frames", 40)

    def survives_faults(self) -> None:
        """Corrupt and short frames are counted; a halted endpoint is cleared; frames go on, and nothing is said."""
        for fault in ("corrupt", "short"):
            self._steer(fault)
            self._grows("corrupt", 1)
            self._done(fault, corrupt=self.health["corrupt"])
        self._steer("halt")
        self._grows("frames", 40)
        if self.health["state"] != "streaming":
            raise Failed(f"after a halt the state is {self.health['state']}")
        self._done("halted")

    def falls_silent(self) -> None:
        """A device that sends nothing is said to have stalled, and heard again when it speaks."""
        self._steer("silent")
        self.waits_for("stalled")
        self._steer("normal")
        self.waits_for("streaming")
        self._grows("frames", 40)
        self._done("stalled")

    def is_touched_again(self) -> None:
        """After all this a finger is found as before."""
        self._steer("touch")
        self._wait("a finger", lambda: self.touched)
        self._steer("release")
        self.is_lifted()
        self._done("touched-again", frames=self.health["frames"])

    # -- listening -----------------------------------------------------------------------------------

    def _grows(self, counter: str, by: int) -> None:
        least = self.health[counter] + by
        self._wait(f"{counter} of {least}", lambda: self.health[counter] >= least)

    def _wait(self, what: str, done: Callable[[], Any]) -> None:
        until = time.monotonic() + self._patience_s
        while not done():
            left_ms = round((until - time.monotonic()) * 1000)
            if left_ms <= 0 or not self._socket.poll(left_ms):
                raise Failed(f"waited {self._patience_s:g} s for {what}; health is {self.health}")
            self._take(json.loads(self._socket.recv_multipart()[1]))

    def _take(self, message: Message) -> None:
        if message["type"] == "health":
            self.health = message
            return
        # Each message holds the full set of contacts.
        self.touched = {c["id"]: c for c in message["contacts"] if c["phase"] != "up"}

    def _done(self, step: str, **found: Any) -> None:
        self.steps.append({"step": step, **found})


def main() -> int:
    """Run the scenario by commands on standard output."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("address", help="of the daemon's bus")
    parser.add_argument("--patience", type=float, default=60.0, metavar="SECONDS")
    parser.add_argument("--lift-ms", type=float, default=LIFT_MS, metavar="MS")
    arguments = parser.parse_args()
    scenario = Scenario(
        arguments.address, lambda command: print(f"!{command}", flush=True), arguments.patience, arguments.lift_ms
    )
    try:
        scenario.run()
    except Failed as failure:
        print(f"failed: {failure}", file=sys.stderr, flush=True)
        return 1
    finally:
        for step in scenario.steps:
            print(json.dumps(step), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
