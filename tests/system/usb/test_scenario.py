"""The daemon's loop over a device in memory, as a subscriber sees it: up within 100 ms, states at once, found again."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S, wait_until
from tests.system.usb.backend import FakeBus, FakeDaq, Transfer
from tests.system.usb.client import Scenario
from tests.system.usb.plate import recorded
from tests.system.usb.player import Player
from tests.system.usb.reader import INFO
from touchd.config.schema import BusSettings, DeviceSettings, HealthSettings, Settings
from touchd.errors import ReaderFailed, TouchdError
from touchd.event import Event, HealthEvent
from touchd.gadget.device import COMMANDS, Gadget
from touchd.localization.model import Model
from touchd.service.daemon import make_pipeline
from touchd.service.loop import Service
from touchd.sinks.sink import Sink
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.usb import open_usb
from touchd.sources.usb_protocol import Flag, FrameReader, Request, build_frame


class Cable:
    """A plate in software on the bus in memory, steered by the scenario's commands."""

    def __init__(self) -> None:
        self.player = Player(*recorded())
        self.gadget = Gadget(INFO, self.player)
        self.flags = 0
        """Of the frames' headers."""
        self.daq = FakeDaq(INFO)
        self.daq.source = self._next
        self.daq.started = self._start

    def _start(self) -> None:
        assert self.gadget.control(0x40, Request.START, self.daq.rate_hz, 0) is not None

    def _next(self) -> Transfer | None:
        wait_s = self.gadget.wait_s()
        if 0 < wait_s < 1:
            threading.Event().wait(wait_s)
        transfer = self.gadget.next_transfer()
        if self.flags and isinstance(transfer, bytes):
            found = FrameReader(INFO).whole(memoryview(transfer))
            assert found is not None
            header, samples = found
            return build_frame(INFO, header._replace(flags=self.flags), bytes(samples))
        return transfer

    def steer(self, command: str) -> None:
        if command in ("plug", "unplug"):
            getattr(self.daq, command)()
        elif command in ("touch", "release"):
            self.player.touch(command == "touch")
        else:
            assert command in COMMANDS
            self.gadget.command(command)


class Heard:
    """A sink that keeps all health messages."""

    def __init__(self) -> None:
        self.health: list[HealthEvent] = []

    def says(self, reason: str) -> bool:
        """Whether the last message gives this reason."""
        return reason in (self.health[-1].reason or "")

    def wants(self, topic: str) -> bool:
        return topic == "health"

    def publish(self, event: Event, received_ns: int) -> None:  # noqa: ARG002 - the protocol's
        if isinstance(event, HealthEvent):
            self.health.append(event)

    def poll(self) -> None:
        pass

    def close(self) -> None:
        pass


class Running:
    """The daemon's own parts, in a thread."""

    def __init__(self, cable: Cable, address: str, model: Model, stall_s: float) -> None:
        device = DeviceSettings(stall_s=stall_s)
        health = HealthSettings(period_s=0.2)
        settings = Settings(bus=BusSettings(bind=(address,)), device=device, health=health)
        bus, self.heard = ZeromqSink(settings.bus), Heard()
        source = open_usb(device, model.description.acquisition, model.check, backend=FakeBus(cable.daq))
        sinks: list[Sink] = [bus, self.heard]
        self.service = Service(source, sinks, settings, make_pipeline(source, settings, model))
        self.pipeline, self.tally = self.service.pipeline, source.tally
        self.error: TouchdError | None = None
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        try:
            self.service.run()
        except TouchdError as error:
            self.error = error

    def end(self) -> None:
        self.service.stop()
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()


@contextmanager
def running(cable: Cable, address: str, model: Model, stall_s: float = 0.3) -> Iterator[Running]:
    daemon = Running(cable, address, model, stall_s)
    try:
        yield daemon
    finally:
        daemon.end()


def test_scenario(tmp_path: Path, model: Model) -> None:
    """Every step of the scenario succeeds, and every frame is counted."""
    address, cable = f"ipc://{tmp_path}/bus", Cable()
    with running(cable, address, model) as daemon:
        scenario = Scenario(address, cable.steer, PATIENCE_S)
        scenario.run()
    assert [step["step"] for step in scenario.steps] == [
        "streaming", "touched", "unplugged", "replugged", "corrupt", "short", "halted", "stalled", "touched-again",
    ]  # fmt: skip
    states = [event.state for event in daemon.heard.health]
    assert [s for s, before in zip(states, ["", *states], strict=False) if s != before][:4] == [
        "starting", "streaming", "lost", "streaming",
    ]  # fmt: skip
    assert states[-1] == "stopping"
    last, counters = daemon.heard.health[-1], daemon.pipeline.counters
    assert (last.corrupt, last.lost) == (2, daemon.tally.lost)
    assert last.frames == last.inferred + sum(counters.skipped.values())
    # The device was away once, so the plate was learned twice.
    assert counters.skipped["learning"] >= 64
    assert cable.daq.opened == cable.daq.closed


def test_withheld(tmp_path: Path, model: Model) -> None:
    """A finger lifts while the device goes on to send frames that measure nothing, and is found again after them."""
    address, cable = f"ipc://{tmp_path}/bus", Cable()
    with running(cable, address, model, stall_s=10) as daemon:  # which alone would lift it, too
        scenario = Scenario(address, cable.steer, PATIENCE_S)
        scenario.begins()
        for flag, reason in ((Flag.EMITTER_FAULT, "emitter fault"), (Flag.TEST_PATTERN, "test pattern")):
            cable.flags = 0
            scenario.is_touched()
            cable.flags = flag
            scenario.is_lifted()
            wait_until(partial(daemon.heard.says, reason))
        scenario.close()
    assert {event.state for event in daemon.heard.health} == {"starting", "streaming", "stopping"}


@pytest.mark.parametrize("moment", ["while it is touched", "before any frame"])
def test_dead_reader(tmp_path: Path, model: Model, moment: str) -> None:
    """A reader that dies ends the service with ReaderFailed."""
    address, cable = f"ipc://{tmp_path}/bus", Cable()

    def die() -> None:
        raise MemoryError("none left")

    if moment == "before any frame":
        cable.daq.started = die
    with running(cable, address, model) as daemon:
        if moment == "while it is touched":
            scenario = Scenario(address, cable.steer, PATIENCE_S)
            scenario.begins()
            scenario.is_touched()
            cable.daq.started = die
            cable.daq.source = lambda: 5  # EIO: it is looked for again, and started
            scenario.is_lifted()
            scenario.close()
        daemon.thread.join(PATIENCE_S)
    assert isinstance(daemon.error, ReaderFailed)
    assert "none left" in str(daemon.error)
    assert daemon.heard.health[-1].state == "stopping"
