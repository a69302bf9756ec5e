"""`DaqSource` reads any `Daq`, and goes on trying."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.processes import PATIENCE_S
from touchd.config.schema import DeviceSettings
from touchd.errors import ReaderFailed
from touchd.frame import Acquisition, Frame
from touchd.recording.data import Device
from touchd.sources.daq import DaqFrame, DaqGone, Waits
from touchd.sources.frame_ring import FrameRing, Lending
from touchd.sources.intake import Intake
from touchd.sources.live import DaqSource
from touchd.sources.source import Change

ACQUISITION = Acquisition(channels=2, samples=30, sample_rate_hz=250e3)
UNHEARD_HZ = 11
"""A rate that the devices here do not answer to."""
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
        if rate_hz == UNHEARD_HZ:
            raise DaqGone("it does not answer SET_RATE")

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


class Steady(Stubborn):
    """A device that sends frames until it fails, and keeps which thread read each."""

    def __init__(self) -> None:
        super().__init__(failures=0)
        self.readers: list[str] = []
        self.waits_s: list[float] = []
        self.fails: Exception | None = None
        self.silent = False
        """Until it is started again."""
        self.interrupted = False
        """Its next read in the main thread meets Ctrl-C."""

    def start(self, rate_hz: int) -> None:
        super().start(rate_hz)
        self.silent = False

    def skip(self, frames: int) -> None:
        """Send these frames to nobody."""
        self._sequence += frames

    def read(self, timeout_s: float) -> DaqFrame | None:
        self.readers.append(threading.current_thread().name)
        self.waits_s.append(timeout_s)
        if self.silent:
            time.sleep(timeout_s)
            return None
        if self.fails is not None:
            raise self.fails
        if self.interrupted and threading.current_thread() is threading.main_thread():
            self.interrupted = False
            raise KeyboardInterrupt
        time.sleep(0.001)
        self._sequence += 1
        counts = np.full(ACQUISITION.shape, self._sequence, np.int16)
        return DaqFrame(counts, self._sequence, 1000 * self._sequence)


class Reading:
    """A source on a steady device, read until something is so."""

    def __init__(self, waits: Waits = AT_ONCE, clock: Callable[[], int] = time.monotonic_ns, **settings: float) -> None:
        self.daq = Steady()
        chosen = DeviceSettings.model_validate({"stall_s": 0.05, **settings})
        self.opened = 0
        self.source = DaqSource(
            lambda: iter([self.open]), chosen, ACQUISITION, lambda _: None, waits=waits, clock=clock
        )
        self.numbers: list[int] = []
        self.states: list[str] = []

    def open(self) -> Steady:
        self.opened += 1
        return self.daq

    def until(self, done: Callable[[], bool]) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < end_s, (self.states, len(self.numbers))
            frame = self.source.read(0.05)
            if frame is not None:
                assert (frame.counts == frame.sequence).all()
                self.numbers.append(frame.sequence)
            self.states += [change.state for change in self.source.changes()]

    def until_direct(self) -> None:
        """Until the reading thread reads the device itself."""
        mine, count = threading.current_thread().name, len(self.daq.readers)
        self.until(lambda: self.daq.readers[count:].count(mine) > 20)


@pytest.fixture
def reading() -> Iterator[Callable[..., Reading]]:
    made: list[Reading] = []

    def make(**settings: Any) -> Reading:
        made.append(Reading(AT_ONCE, **settings))
        return made[-1]

    yield make
    for one in made:
        one.source.close()
        assert one.daq.closed == one.opened


def test_one_thread(reading: Callable[..., Reading]) -> None:
    """Once frames come steadily, the thread that wants them reads the device: each wakes one thread."""
    one = reading()
    one.until_direct()
    assert one.numbers == list(range(1, len(one.numbers) + 1)), "none is lost where the threads change"
    assert set(one.daq.readers[-20:]) == {threading.current_thread().name}


@pytest.mark.parametrize("before", ["starting", "streaming", "silent"])
def test_busy_caller(before: str) -> None:
    """A caller that is busy for longer than a thread may hang, a start or a change of model, finds its frames after."""
    one = Reading(waits=replace(AT_ONCE, hang_s=0.2))
    try:
        if before == "starting":
            end_s = time.monotonic() + PATIENCE_S
            while len(one.daq.readers) < 20:
                assert time.monotonic() < end_s, "nobody reads the device while the caller is busy"
                time.sleep(0.01)
        else:
            one.until_direct()
        one.daq.silent = before == "silent"
        time.sleep(0.5)
        count = len(one.numbers)
        one.until(lambda: len(one.numbers) > count + 20)
    finally:
        one.source.close()


@pytest.mark.parametrize(("away_ns", "lost", "behind"), [(80_000_000, 0, 10), (79_999_999, 10, 0)])
def test_frames_that_the_device_could_not_keep(
    reading: Callable[..., Reading], away_ns: int, lost: int, behind: int
) -> None:
    """Ten frames missing after their reader was away for as long were not lost by a cable: this computer was behind."""
    now_ns = 10**12
    one = reading(clock=lambda: now_ns, rate_hz=125)
    one.until_direct()
    now_ns += away_ns
    one.daq.skip(10)
    count = len(one.numbers)
    one.until(lambda: len(one.numbers) > count)
    assert (one.source.tally.lost, one.source.tally.behind) == (lost, behind)


def test_low_rate(reading: Callable[..., Reading]) -> None:
    """At a low rate neither a loan ends nor a stream has stalled before three frames are missing."""
    lent = reading()
    lent.until_direct()
    lent.source.set_rate(10)
    lent.until(lambda: lent.daq.waits_s[-1] == pytest.approx(0.3))
    one = reading(rate_hz=500)
    one.until(lambda: len(one.numbers) > 50)
    one.source.set_rate(10)
    since_s, one.daq.silent = time.monotonic(), True
    one.until(lambda: "stalled" in one.states)
    assert time.monotonic() - since_s > 0.25, "0.05 s is a stall at the full rate"


def test_no_answer(reading: Callable[..., Reading]) -> None:
    """Whoever asks for a rate learns that the device did not answer; the stream goes on."""
    one = reading()
    one.until(lambda: len(one.numbers) > 5)
    assert [one.source.set_rate(rate_hz) for rate_hz in (10, UNHEARD_HZ, 125)] == [True, False, True]
    count = len(one.numbers)
    one.until(lambda: len(one.numbers) > count + 5)
    assert one.states == ["streaming"]


def test_a_loan_that_begins_just_before_a_wait(
    reading: Callable[..., Reading], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The caller that has seen no loan, and is about to wait for frames, reads the device that is lent by then."""
    pending, waits, woken = (threading.Event() for _ in range(3))
    lend, wake, take = Lending.lend, FrameRing.wake, FrameRing.take

    def lend_late(*call: Any) -> None:
        pending.set()
        waits.wait(PATIENCE_S)
        lend(*call)

    def wake_early(*call: Any) -> None:
        wake(*call)
        woken.set()

    def take_late(ring: FrameRing[Change], *call: Any) -> Frame | None:
        if pending.is_set() and not ring.waiting:
            waits.set()
            woken.wait(PATIENCE_S)
        return take(ring, *call)

    monkeypatch.setattr(Lending, "lend", lend_late)
    monkeypatch.setattr(FrameRing, "wake", wake_early)
    monkeypatch.setattr(FrameRing, "take", take_late)
    one = reading()
    since_s = time.monotonic()
    while not woken.is_set():
        one.source.read(PATIENCE_S)
        one.source.changes()
    assert time.monotonic() - since_s < PATIENCE_S


def test_high_rate(reading: Callable[..., Reading]) -> None:
    """At high rates a thread reads on while a frame is processed."""
    one = reading(rate_hz=500)
    one.until(lambda: len(one.numbers) > 50)
    assert set(one.daq.readers) == {"touchd-daq"}


def test_unplugged_while_lent(reading: Callable[..., Reading]) -> None:
    """A device that goes while the other thread reads it is lost, and read again once it is back."""
    one = reading()
    one.until_direct()
    one.daq.fails = DaqGone("it is gone")
    one.until(lambda: "lost" in one.states)
    one.daq.fails = None
    one.until_direct()
    assert one.states == ["streaming", "lost", "streaming"]


def test_silent_while_lent(reading: Callable[..., Reading]) -> None:
    """A device that falls silent while the other thread reads it has stalled, and is restarted."""
    one = reading()
    one.until_direct()
    one.daq.silent = True
    one.until(lambda: "stalled" in one.states)
    one.until_direct()
    assert one.daq.starts == 2
    assert one.states == ["streaming", "stalled", "streaming"]
    assert one.numbers == list(range(1, len(one.numbers) + 1))


def test_failure_while_lent(reading: Callable[..., Reading]) -> None:
    """An error that nobody expects comes out of `read`."""
    one = reading()
    one.until_direct()
    one.daq.fails = ZeroDivisionError("as never expected")
    with pytest.raises(ReaderFailed, match="as never expected"):
        one.until(lambda: False)


def test_interrupt_while_lent(reading: Callable[..., Reading]) -> None:
    """Ctrl-C is the caller's own: the device goes back, and can be read again."""
    one = reading()
    one.until_direct()
    one.daq.interrupted = True
    with pytest.raises(KeyboardInterrupt):
        one.until(lambda: False)
    one.until_direct()
    assert one.states == ["streaming"]
    assert one.numbers == list(range(1, len(one.numbers) + 1))


def test_corrupt_frames_count_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A caller that is slow to notice the end of a loan does not count a device again on its next connection."""
    daqs: list[Steady] = []
    counts: list[int] = []
    read, count = Lending.read, Intake.count_corrupt

    def connect() -> Steady:
        daqs.append(Steady())
        daqs[-1].corrupt = 3 if len(daqs) == 1 else 0
        return daqs[-1]

    def read_slowly(lending: Lending, timeout_s: float) -> DaqFrame | None:
        found = read(lending, timeout_s)
        until = time.monotonic() + PATIENCE_S
        while found is None and (len(daqs) == 1 or not daqs[1].readers) and time.monotonic() < until:
            time.sleep(0.001)
        return found

    def count_seen(intake: Intake, daq: Steady) -> None:
        count(intake, daq)
        counts.append(intake.tally.corrupt)

    monkeypatch.setattr(Lending, "read", read_slowly)
    monkeypatch.setattr(Intake, "count_corrupt", count_seen)
    source = DaqSource(lambda: iter([connect]), DeviceSettings(), ACQUISITION, lambda _: None, waits=AT_ONCE)
    mine, until = threading.current_thread().name, time.monotonic() + PATIENCE_S
    while not (len(daqs) > 1 and daqs[1].readers) and time.monotonic() < until:
        source.read(0.05)
        source.changes()
        if mine in daqs[0].readers:
            daqs[0].fails = DaqGone("it is gone")
    source.close()
    assert len(daqs) == 2
    assert set(counts) == {3}
