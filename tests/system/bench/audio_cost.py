"""`python -m tests.system.bench.audio_cost`: how long a frame takes from an audio interface, beside a USB DAQ's.

Plates of another simulator are calibrated untouched, one with each device's acquisition, and a fingertip circles on
each. Cards and transfers are fakes at the seams of their libraries, which hand over samples when they are due; from
there on all is the daemon's. What is counted is the time from the last sample's hand-over until a touch message is
sent. The daemons take turns; the median of the turns' ratios comes last.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import zmq

from tests.processes import ROOT, environment
from touchd.audio.capture import periods_of
from touchd.audio.card import Floats, Samples
from touchd.calibration.calibrate import make_model
from touchd.config.rigs import AudioSettings
from touchd.config.schema import LogSettings, Settings
from touchd.event import Event, TouchEvent
from touchd.frame import Acquisition
from touchd.lab.benchmark.steady_child import Device
from touchd.lab.plates import table
from touchd.lab.plates.cases import make
from touchd.service.daemon import load_model, make_pipeline
from touchd.service.log import configure
from touchd.service.loop import Service
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.audio import AudioDaq, acquisition_of
from touchd.sources.live import DaqSource
from touchd.sources.usb_stream import UsbDaq

CASES = {"usb": "glass-200x200x5", "audio-192": "audio-192", "audio-96": "audio-96"}
RATE_HZ, LEAD, TURNS = 125, 250, 5
WARM_S, SECONDS = 4.0, 6.0
BLOCK_S = 1e-3
NOISE_COUNTS = 6.0
"""About 60 dB below the plate's response. Chirps without noise of their own would be no steady plate: never learned."""
AUDIO = {
    "audio-192": AudioSettings(sample_rate_hz=192_000, band_hz=(20e3, 85e3), chirp_s=4e-3),
    "audio-96": AudioSettings(sample_rate_hz=96_000, band_hz=(15e3, 44e3), chirp_s=1e-3),
}


class PacedCard:
    """A card whose capture plays a recording's frames to and fro, in blocks of 1 ms when they are due."""

    name, due_ns = "hw:CARD=Paced", 0

    def __init__(self, frames: Samples, a: Acquisition) -> None:
        _, chirps = periods_of(a, RATE_HZ)
        there = frames[LEAD:]
        played = np.concatenate([frames[:LEAD], *[there, there[-2:0:-1]] * 10])
        # A frame is the mean of its chirps, whichever is its first: each has noise of its own.
        played = np.repeat(played, chirps, axis=0)
        noise = np.random.default_rng(0).normal(0, NOISE_COUNTS, (50, *a.shape)).astype(np.int16)
        played += np.resize(noise, played.shape)
        delayed = np.zeros((137, a.channels), np.int16)
        self._captured: Samples = np.concatenate([delayed, played.transpose(0, 2, 1).reshape(-1, a.channels)])
        self.rate_hz, self.inputs = round(a.sample_rate_hz), a.channels
        self.ahead, self._block = self.rate_hz // 10, round(BLOCK_S * self.rate_hz)

    def start(self, loop: Floats) -> None:  # noqa: ARG002 - the protocol's
        """Begin with the first block."""
        self._at, self._began_ns = 0, time.monotonic_ns()

    def play(self, loop: Floats) -> None:
        """Go on: the delay has no fraction."""

    def exchange(self, timeout_s: float) -> Samples | None:
        """Return the next block once it is due."""
        end = self._at + self._block
        due_ns = self._began_ns + end * 1_000_000_000 // self.rate_hz
        left_ns = due_ns - time.monotonic_ns()
        time.sleep(max(min(left_ns * 1e-9, timeout_s), 0.0))
        if left_ns > timeout_s * 1e9:
            return None
        block, self._at, self.due_ns = self._captured[self._at : end], end, due_ns
        return block

    def close(self) -> None:
        """Do nothing."""


def source_of(kind: str, frames: Samples, settings: Settings, reference: Floats) -> tuple[DaqSource, Callable[[], int]]:
    """Return a device as a source, and what tells when its last samples were due, ns."""
    if kind == "usb":
        device = Device(frames, LEAD)
        device.go.set()
        usb = UsbDaq(device)
        source = DaqSource(lambda: iter([lambda: usb]), settings.device, usb.acquisition, lambda _: None)
        return source, lambda: device.due_ns[-1]
    a = acquisition_of(AUDIO[kind])
    card = PacedCard(frames, a)
    audio = AudioDaq(card, AUDIO[kind], a, reference)
    source = DaqSource(lambda: iter([lambda: audio]), settings.device, a, lambda _: None, direct=False)
    return source, lambda: card.due_ns


def run(kind: str, folder: Path) -> float:
    """Return the median time from the last sample to the sent message, us."""
    configure(LogSettings(level="error"))
    address = f"ipc://{folder}/bus"
    settings = Settings.model_validate({
        "bus": {"bind": [address]}, "device": {"rate_hz": RATE_HZ, "idle_rate_hz": RATE_HZ, "stall_s": 10.0},
        "model": {"path": str(folder / kind / "plate.onnx")},
    })  # fmt: skip
    model = load_model(settings)
    assert model is not None
    assert model.atlas is not None
    frames: Samples = np.load(folder / kind / "circle.npy")
    source, due_ns = source_of(kind, frames, settings, model.atlas.baseline.astype(np.float64))
    bus = ZeromqSink(settings.bus)
    service = Service(source, [bus], settings, make_pipeline(source, settings, model))
    threading.Thread(target=_listen, args=(address,), daemon=True).start()
    took_us: list[float] = []
    publish, began_s = bus.publish, time.monotonic()

    def noted(event: Event, received_ns: int) -> None:
        publish(event, received_ns)
        gone_s = time.monotonic() - began_s
        if gone_s > WARM_S and isinstance(event, TouchEvent):
            took_us.append((time.monotonic_ns() - due_ns()) * 1e-3)
        if gone_s > WARM_S + SECONDS:
            service.stop()

    bus.publish = noted  # type: ignore[method-assign]
    service.run()
    return median(took_us)


def _listen(address: str) -> None:
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.connect(address)
        socket.subscribe(b"touch")
        while True:
            socket.recv_multipart()


def prepare(kind: str, folder: Path) -> None:
    """Calibrate the plate of a device, and let a fingertip circle on it, once a start has learned the untouched."""
    from touchd.twin.simulate import simulate_scene

    (folder / kind).mkdir()
    made = make(CASES[kind], 0)
    make_model(table.calibrate(made, 0), folder / kind / "plate.onnx")
    circle = simulate_scene("circle", instrument=made.instrument, electronics=made.electronics, seed=11)
    assert circle.contacts_mm is not None
    down = np.flatnonzero(np.isfinite(circle.contacts_mm[:, 0, 0]))
    untouched = np.tile(circle.frames[: down[0]].mean(axis=0).astype(np.int16), (LEAD, 1, 1))
    untouched += np.random.default_rng(1).normal(0, NOISE_COUNTS, untouched.shape).astype(np.int16)
    np.save(folder / kind / "circle.npy", np.concatenate([untouched, circle.frames[down[0] : down[-1]]]))


def main() -> None:
    """Measure all in turns."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    with tempfile.TemporaryDirectory(prefix="touchd-audio-") as name:
        for kind in CASES:
            prepare(kind, Path(name))
        ratios: dict[str, list[float]] = {kind: [] for kind in CASES}
        for turn in range(TURNS):
            took: dict[str, float] = {}
            for kind in list(CASES)[:: 1 if turn % 2 else -1]:
                child = [sys.executable, "-m", f"{__package__}.audio_cost", kind, name]
                told = subprocess.run(child, check=True, capture_output=True, text=True, cwd=ROOT, env=environment())
                took[kind] = float(told.stdout)
            for kind, taken_us in took.items():
                ratios[kind].append(taken_us / took["usb"])
            print(", ".join(f"{kind} {taken_us:.0f} us" for kind, taken_us in took.items()), flush=True)
    print(", ".join(f"{kind} {median(found):.2f} x USB" for kind, found in ratios.items()))


if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1] in CASES:
        print(run(sys.argv[1], Path(sys.argv[2])))
    else:
        main()
