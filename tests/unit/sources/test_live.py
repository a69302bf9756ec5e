"""`DaqSource` reads any `Daq`, and goes on trying."""

from __future__ import annotations

import time

import numpy as np

from tests.processes import PATIENCE_S
from touchd.config.schema import DeviceSettings
from touchd.frame import Acquisition
from touchd.recording.data import Device
from touchd.sources.daq import DaqFrame, DaqGone
from touchd.sources.live import DaqSource, Waits
from touchd.sources.source import Change

ACQUISITION = Acquisition(channels=2, samples=30, sample_rate_hz=250e3)
AT_ONCE = Waits(read_s=0.01, retry_s=1e-6, max_retry_s=1e-6)


class Stubborn:
    """A device that fails to start a number of times, then sends frames."""

    acquisition, device, min_rate_hz, max_rate_hz, corrupt = ACQUISITION, Device(serial="SN1"), 1, 1000, 0

    def __init__(self, failures: int) -> None:
        self.starts = self.closed = self._sequence = 0
        self._failures = failures

    def start(self, rate_hz: int) -> None:  # noqa: ARG002 - the protocol's
        self.starts += 1
        if self.starts <= self._failures:
            raise DaqGone("it refuses START")

    def set_rate(self, rate_hz: int) -> None:
        pass

    def stop(self) -> None:
        pass

    def read(self, timeout_s: float) -> DaqFrame | None:
        time.sleep(timeout_s)
        self._sequence += 1
        counts = np.full(ACQUISITION.shape, self._sequence, np.int16)
        return DaqFrame(counts, self._sequence, 8000 * self._sequence)

    def reset(self) -> None:
        pass

    def close(self) -> None:
        self.closed += 1


def test_a_device_is_tried_again_for_ever() -> None:
    """After more failures than a float has powers of two the thread still lives, and reads the first frame."""
    daq = Stubborn(1100)
    source = DaqSource(lambda: iter([lambda: daq]), DeviceSettings(), ACQUISITION, lambda _: None, waits=AT_ONCE)
    until, frame, states = time.monotonic() + PATIENCE_S, None, []
    while frame is None and time.monotonic() < until:
        frame = source.read(0.1)
        states += [change.state for change in source.changes()]
    source.close()
    assert frame is not None
    assert (frame.counts == frame.sequence).all()
    assert states == ["lost", "streaming"]
    assert (daq.starts, daq.closed) == (1101, 1101)
    assert source.device.serial == "SN1"


class Ticking(Stubborn):
    """A device whose clock counts milliseconds, on a computer whose clock goes on by 8 ms a frame."""

    def __init__(self) -> None:
        super().__init__(failures=0)
        self.now_ns = 10**12

    def read(self, timeout_s: float) -> DaqFrame | None:  # noqa: ARG002 - it never waits
        time.sleep(1e-4)
        self._sequence += 1
        self.now_ns += 8_000_000
        return DaqFrame(np.zeros(ACQUISITION.shape, np.int16), self._sequence, 8 * self._sequence)


def test_a_wrong_clock_is_named() -> None:
    """The reason says that the device's clock is wrong, while frames go on with the times of their arrival."""
    daq = Ticking()
    source = DaqSource(
        lambda: iter([lambda: daq]), DeviceSettings(), ACQUISITION, lambda _: None, clock=lambda: daq.now_ns
    )
    until = time.monotonic() + PATIENCE_S
    changes: list[Change] = []
    while not (changes and "clock" in changes[-1].reason) and time.monotonic() < until:
        source.read(0.1)
        changes += source.changes()
    frame = None
    while frame is None and time.monotonic() < until:
        frame = source.read(0.1)
    source.close()
    assert [change.state for change in changes] == ["streaming", "streaming"]
    assert changes[0].reason == "", "what is wrong with the frames themselves has room"
    assert "runs at 0.001 times the right rate" in changes[-1].reason
    assert frame is not None
    assert frame.t_ns == frame.received_ns - 120_000
