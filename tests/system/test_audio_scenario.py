"""The daemon with an audio interface, as a subscriber sees it: the steps of `make kiosk-test` on a fake of the library.

Time passes by the card's samples alone.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np

from tests.audiocard import FakeCard
from tests.processes import PATIENCE_S
from tests.system.usb.client import Scenario
from touchd.audio.card import CardAbsent, Samples
from touchd.cli.demo import SESSION
from touchd.config.rigs import AudioSettings
from touchd.config.schema import BusSettings, DeviceSettings, HealthSettings, Settings
from touchd.localization.model import Model
from touchd.recording.format import read
from touchd.service.daemon import make_pipeline
from touchd.service.loop import Service
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.audio import AudioDaq
from touchd.sources.daq import DaqAbsent, Waits
from touchd.sources.live import DaqSource

PERIOD = 2000
SETTINGS = AudioSettings(sample_rate_hz=250_000, band_hz=(50e3, 100e3), chirp_s=1e-3)


class Interface(FakeCard):
    """A card with the demo's plate, steered by the scenario's commands; some times as fast as a real one."""

    def __init__(self) -> None:
        session = read(SESSION)
        assert session.contacts_mm is not None
        touched = ~np.isnan(session.contacts_mm[..., 0]).all(axis=1)
        edges = np.flatnonzero(np.diff(touched.astype(int), prepend=0, append=0))
        begin, end = max(zip(edges[::2], edges[1::2], strict=True), key=lambda run: int(run[1] - run[0]))
        self._untouched, self._finger = session.frames[: edges[0] - 5], session.frames[begin + 20 : end - 20]
        self._played = self._untouched
        self.delays: list[float] = []
        super().__init__(session.acquisition, lambda n: self._played[n % len(self._played)].astype(float), PERIOD)

    def steer(self, command: str) -> None:
        if command in ("touch", "release"):
            self._played = self._finger if command == "touch" else self._untouched
        elif command in ("plug", "unplug"):
            self.unplugged = command == "unplug"
        elif command == "xrun":
            self.xrun = True
        else:
            self.silent = command == "silent"

    def start(self, loop: np.ndarray) -> None:
        super().start(loop)
        self.delays.append(self.delay)

    def exchange(self, timeout_s: float) -> Samples | None:
        time.sleep(1e-4)  # others run, too: the card's clock is its samples
        return super().exchange(timeout_s)


class Steps(Scenario):
    """The scenario of a DAQ on USB, with an xrun for what USB alone has."""

    def survives_faults(self) -> None:
        """The frames of an xrun are counted, and the finger that is down meanwhile is found where it was."""
        self._steer("touch")
        self._wait("a finger", lambda: self.touched)
        self._steer("xrun")
        self._wait("an xrun", lambda: self.health["skipped"].get("xrun"))
        self._grows("frames", 40)
        self._wait("a finger", lambda: self.touched)
        self._steer("release")
        self.is_lifted()
        self._done("xrun")


def test_scenario(tmp_path: Path, atlas_model: Model) -> None:
    """Fingers are found and lifted through an xrun, a card that goes, comes, and falls silent; each start finds its own
    delay."""
    assert atlas_model.atlas is not None
    card, reference = Interface(), atlas_model.atlas.baseline.astype(float)
    device = DeviceSettings(queue_frames=1000)
    settings = Settings(
        bus=BusSettings(bind=(f"ipc://{tmp_path}/bus",)), device=device, health=HealthSettings(period_s=0.2)
    )

    def connect() -> AudioDaq:
        try:
            return AudioDaq(card.open(), SETTINGS, atlas_model.description.acquisition, reference, clock=card.clock)
        except CardAbsent as absent:
            raise DaqAbsent(str(absent)) from absent

    source = DaqSource(
        lambda: iter([connect]), device, atlas_model.description.acquisition, lambda _: None,
        waits=Waits(0.01, 1e-3, 2e-3), clock=card.clock, direct=False,
    )  # fmt: skip
    pipeline = make_pipeline(source, settings, atlas_model)
    service = Service(source, [ZeromqSink(settings.bus)], settings, pipeline, clock=card.clock)
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        scenario = Steps(settings.bus.bind[0], card.steer, PATIENCE_S)
        scenario.run()
    finally:
        service.stop()
        thread.join(PATIENCE_S)
    assert [step["step"] for step in scenario.steps] == [
        "streaming", "touched", "unplugged", "replugged", "xrun", "stalled", "touched-again",
    ]  # fmt: skip
    assert len(set(card.delays)) == len(card.delays) >= 4
