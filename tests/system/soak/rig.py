"""The whole daemon on a device in memory that sends a great many frames, some bad, and is unplugged at times."""

from __future__ import annotations

import gc
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from tests.system.usb.backend import FakeBus, FakeDaq, Transfer
from tests.system.usb.plate import recorded
from tests.system.usb.reader import INFO
from touchd.config.schema import BusSettings, DeviceSettings, Settings
from touchd.event import Contact, Event
from touchd.frame import Frame
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service.daemon import make_pipeline
from touchd.service.loop import Service
from touchd.service.preroll import PreRoll
from touchd.sinks.sink import Sink
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.live import DaqSource
from touchd.sources.usb import open_usb
from touchd.sources.usb_protocol import Flag

CORRUPT_EVERY = 10_000
SKIP_EVERY = 25_000
TEST_EVERY = 50_000
UNPLUG_EVERY = 60_000  # once a minute at 1000 frames a second
TOUCH_FRAMES = 2_000  # a finger for so many frames, then none for as many
_AWAY_S = 0.2
_NUMBER_BITS = 32
_SAMPLE_EVERY = 2_000


@dataclass
class Sent:
    """What the device did."""

    valid: int = 0
    corrupt: int = 0
    skipped: int = 0
    tests: int = 0
    unplugged: int = 0


class Device:
    """Sends numbered frames of a plate that is touched now and then; the lowest bits of 32 samples hold the number.

    Parameters
    ----------
    frames : int
        After so many it falls silent.
    rate_hz : float
        Infinite is as fast as they are taken.
    """

    def __init__(self, frames: int, rate_hz: float, seed: int = 0) -> None:
        self.sent = Sent()
        self.daq = FakeDaq(INFO)
        self.daq.source = self._next
        self.room = threading.Semaphore(32)
        self._frames, self._rate_hz = frames, rate_hz
        self._rng = np.random.default_rng(seed)
        self._paced = rate_hz < float("inf")
        self._plates = [self._as_counts(frames) for frames in recorded()]
        self._begun_s = 0.0
        self._number = 0
        self._just_plugged = True

    @property
    def done(self) -> bool:
        """Whether all is sent."""
        return self._number >= self._frames

    @staticmethod
    def _as_counts(frames: Sequence[bytes]) -> NDArray[np.int16]:
        return np.array([np.frombuffer(frame, "<i2").reshape(INFO.samples, INFO.channels) for frame in frames])

    def _next(self) -> Transfer | None:
        if self.done:
            return None
        n = self._number
        if n and n % UNPLUG_EVERY == 0 and not self._just_plugged:
            self._unplug()
            return None
        if self._paced:
            self._wait_for(n)
        elif not self.room.acquire(timeout=0.02):
            return None
        self._number += 1
        if self._hits(SKIP_EVERY) and not self._just_plugged:
            self.sent.skipped += 1
            self.room.release()
            return None
        data = self._frame(n)
        if self._hits(CORRUPT_EVERY):
            self.sent.corrupt += 1
            self.room.release()
            at = int(self._rng.integers(len(data)))
            return data[:at] + bytes([data[at] ^ 1 << int(self._rng.integers(8))]) + data[at + 1 :]
        self._just_plugged = False
        self.sent.valid += 1
        return data

    def _hits(self, every: int) -> bool:
        return bool(self._rng.integers(every) == 0)

    def _frame(self, n: int) -> bytes:
        plate = self._plates[n // TOUCH_FRAMES % 2]
        counts = plate[n % len(plate)].copy()
        bits = n >> np.arange(_NUMBER_BITS) & 1
        counts[:_NUMBER_BITS, 0] = counts[:_NUMBER_BITS, 0] & ~1 | bits
        flags = Flag.TEST_PATTERN if self._hits(TEST_EVERY) else Flag(0)
        if flags:
            self.sent.tests += 1
            self.room.release()
        now_us = int(n * 1e6 / self._rate_hz) if self._paced else time.monotonic_ns() // 1000
        return self.daq.frame(counts.tobytes(), sequence=n % 2**32, timestamp_us=now_us, flags=flags)

    def _wait_for(self, n: int) -> None:
        now_s = time.monotonic()
        self._begun_s = self._begun_s or now_s - n / self._rate_hz
        time.sleep(max(0.0, self._begun_s + n / self._rate_hz - now_s))

    def _unplug(self) -> None:
        self.sent.unplugged += 1
        self._just_plugged = True
        self._begun_s = 0.0
        self.daq.unplug()
        threading.Timer(_AWAY_S, self.daq.plug).start()


@dataclass
class Found:
    """What the daemon made of it."""

    frames: int = 0
    twice: int = 0
    """Frames whose number was not above the one before."""
    rss_kb: list[int] = field(default_factory=list)
    """Memory of this process, sampled all along."""
    _latency_us: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    _latencies: int = 0

    def expect(self, frames: int) -> None:
        """Take the memory for so many frames now, so that later growth is the daemon's."""
        self._latency_us = np.ones(frames + 1, np.float32)

    def took(self, latency_us: float) -> None:
        """Note how long a frame took."""
        self._latency_us[self._latencies] = latency_us
        self._latencies += 1

    @property
    def latency_us(self) -> NDArray[np.float32]:
        """Of every frame: complete on the host to all its messages handed to the socket."""
        return self._latency_us[: self._latencies]


class Watch:
    """A sink that looks after the frames rather than the messages."""

    def __init__(self, device: Device) -> None:
        self.found = Found()
        self.events = 0
        self.service: Service | None = None
        self._device = device
        self._last = -1
        self._taken = -1

    def keep(self, frame: Frame, _contacts: Sequence[Contact]) -> None:
        """Check a frame that is done, and let the device send the next one."""
        self.found.took((time.monotonic_ns() - frame.received_ns) * 1e-3)
        bits = (frame.counts[0, :_NUMBER_BITS] & 1).astype(np.int64)
        number = int((bits << np.arange(_NUMBER_BITS)).sum())
        self.found.frames += 1
        self.found.twice += number <= self._last
        self._last = number
        self._device.room.release()
        if self.found.frames % _SAMPLE_EVERY == 0:
            self.found.rss_kb.append(rss_kb())

    def wants(self, topic: str) -> bool:
        return topic != "spectrum"

    def publish(self, event: Event, received_ns: int) -> None:  # noqa: ARG002 - the protocol's
        self.events += 1

    def poll(self) -> None:
        """Called between frames."""
        if self._device.done and self._taken == self.found.frames and self.service is not None:
            self.service.stop()
        self._taken = self.found.frames

    def close(self) -> None:
        pass


@dataclass
class Result:
    """A run, and what each side says of it."""

    sent: Sent
    found: Found
    source: DaqSource
    pipeline: Pipeline
    events: int
    seconds: float


def run(frames: int, rate_hz: float, folder: Path, model: Model, seed: int = 0) -> Result:
    """Run the daemon's parts until the device has sent so many frames."""
    device = Device(frames, rate_hz, seed)
    wanted = DeviceSettings(rate_hz=int(min(rate_hz, 1000)), stall_s=10.0)
    settings = Settings(bus=BusSettings(bind=(f"ipc://{folder}/bus",)), device=wanted)
    source = open_usb(wanted, model.description.acquisition, model.check, backend=FakeBus(device.daq))
    watch = Watch(device)
    watch.found.expect(frames)
    sinks: list[Sink] = [watch, ZeromqSink(settings.bus)]
    pipeline = make_pipeline(source, settings, model)
    service = watch.service = Service(source, sinks, settings, pipeline, preroll=cast(PreRoll, watch))
    gc.collect()
    begun_s = time.monotonic()
    service.run()
    return Result(device.sent, watch.found, source, service.pipeline, watch.events, time.monotonic() - begun_s)


def rss_kb() -> int:
    """Return the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def complaints(result: Result) -> list[str]:
    """What is wrong with a run: frames twice, losses that are not counted, memory that grows."""
    sent, found, tally, counters = result.sent, result.found, result.source.tally, result.pipeline.counters
    wrong = []
    expected = {
        "frames + behind + withheld": (
            found.frames + tally.behind + sum(tally.withheld.values()), sent.valid
        ),
        "withheld": (sum(tally.withheld.values()), sent.tests),
        "corrupt": (tally.corrupt, sent.corrupt),
        "lost": (tally.lost, sent.skipped),
        "processed twice": (found.twice, 0),
        "repeated": (counters.repeated, 0),
        "frames by what became of them": (counters.inferred + sum(counters.skipped.values()), counters.frames),
    }  # fmt: skip
    wrong = [f"{name}: {is_} instead of {should}" for name, (is_, should) in expected.items() if is_ != should]
    settled = found.rss_kb[len(found.rss_kb) // 5 :]
    if settled and max(settled) - settled[0] > 8192:
        wrong.append(f"memory grows from {settled[0]} to {max(settled)} kB")
    return wrong
