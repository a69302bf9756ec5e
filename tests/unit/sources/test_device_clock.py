"""The device's clock becomes this computer's: without drift, without the jitter of arrival, and never backwards."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from touchd.client import MAX_AGE_S
from touchd.config.schema import Settings
from touchd.frame import Frame
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.recording.data import Recording
from touchd.sources.device_clock import DeviceClock

COMPLETE_NS = 1_000_000
LEAST_DELAY_NS = 120_000  # of a transfer; nothing on this side can tell it from an offset of the clocks


class Link:
    """Chirps at a steady rate by the device's clock, which is off and fast; frames that arrive late by chance."""

    def __init__(
        self, seconds: float, *, rate_hz: float = 125.0, ppm: float, jitter_us: float, seed: int, start_us: int = 12345
    ) -> None:
        rng = np.random.default_rng(seed)
        n = round(seconds * rate_hz)
        self.true_ns: NDArray[np.floating[Any]] = 7e12 + np.arange(n) * 1e9 / rate_hz
        device_ns = (self.true_ns - self.true_ns[0]) * (1 + ppm * 1e-6)
        self.timestamp_us = start_us + np.floor(device_ns / 1000).astype(np.int64)
        delay_ns = LEAST_DELAY_NS + rng.exponential(jitter_us * 1000, n)
        # A busy computer: now and then nothing is fetched for a while, and then all that waited at once.
        for at in rng.integers(0, n, n // 200):
            burst = min(n - at, int(rng.integers(1, 20)))
            delay_ns[at : at + burst] += np.maximum(0, 40e6 - np.arange(burst) * 1e9 / rate_hz)
        arrival = np.maximum.accumulate(self.true_ns + COMPLETE_NS + delay_ns)
        self.received_ns: NDArray[np.int64] = arrival.astype(np.int64)

    def through(self, clock: DeviceClock) -> NDArray[np.floating[Any]]:
        """Mapped times less the true ones, ns."""
        mapped = [clock.map(int(t), int(r)) for t, r in zip(self.timestamp_us, self.received_ns, strict=True)]
        assert all(b > a for a, b in pairwise(mapped)), "time increases"
        error_ns: NDArray[np.floating[Any]] = np.array(mapped) - self.true_ns - LEAST_DELAY_NS
        return error_ns


@settings(max_examples=20)
@given(
    ppm=st.floats(-300, 300),
    jitter_us=st.floats(10, 500),
    rate_hz=st.sampled_from([50.0, 125.0, 500.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_accuracy(ppm: float, jitter_us: float, rate_hz: float, seed: int) -> None:
    """After 20 s every time is right to a fraction of a millisecond, without drift."""
    link, clock = Link(40, rate_hz=rate_hz, ppm=ppm, jitter_us=jitter_us, seed=seed), DeviceClock(COMPLETE_NS)
    error_ns = link.through(clock)
    settled = error_ns[round(20 * rate_hz) :]
    assert np.abs(settled).max() < 100_000 + jitter_us * 200
    assert clock.ppm == pytest.approx(ppm, abs=1 + jitter_us / 20)
    # By arrival alone the worst of these frames would be 40 ms off.
    assert (link.received_ns - link.true_ns).max() > 20e6


@pytest.mark.parametrize("ppm", [-100.0, 0.0, 100.0])
def test_an_hour(ppm: float) -> None:
    """After an hour the error is no larger than after a minute."""
    link = Link(3600, rate_hz=10, ppm=ppm, jitter_us=100, seed=3)
    error_ns = np.abs(link.through(DeviceClock(COMPLETE_NS)))
    assert error_ns[600:].max() < 200_000
    assert error_ns[-600:].max() < 200_000


def test_jitter() -> None:
    """The interval of frames is the device's to 10 us, at 300 us of jitter."""
    link = Link(40, ppm=50, jitter_us=300, seed=5)
    error_ns = link.through(DeviceClock(COMPLETE_NS))[1250:]
    assert np.abs(np.diff(error_ns)).max() < 10_000, "steps of 8 ms are right to 10 us"


def test_late_first_frame() -> None:
    """A late first frame is corrected within seconds, without a jump."""
    link = Link(10, ppm=20, jitter_us=50, seed=6)
    link.received_ns[:5] += 80_000_000
    link.received_ns = np.maximum.accumulate(link.received_ns)
    error_ns = link.through(DeviceClock(COMPLETE_NS))
    assert error_ns[0] > 70e6
    assert abs(error_ns[-1]) < 1e6
    assert np.abs(np.diff(error_ns)).max() <= 0.1 * 8e6 + 10_000


@pytest.mark.parametrize("jump_us", [-10_000_000, 50_000_000, 2**50])
def test_clock_is_set(jump_us: int) -> None:
    """A device clock that is set is followed at once."""
    link = Link(20, ppm=20, jitter_us=50, seed=7, start_us=20_000_000)
    link.timestamp_us[1250:] += jump_us
    error_ns = link.through(DeviceClock(COMPLETE_NS))
    assert np.abs(error_ns[1250:]).max() < 45e6
    assert np.abs(error_ns[2000:]).max() < 1e6


def test_no_clock() -> None:
    """Frames of a device without a clock get times of arrival, which increase."""
    clock = DeviceClock(COMPLETE_NS)
    times = [clock.map(0, received_ns) for received_ns in (10_000_000, 18_000_000, 18_000_000, 17_000_000, 26_000_000)]
    assert times[:2] == [9_000_000, 17_000_000]
    assert all(b > a for a, b in pairwise(times))


def test_delay() -> None:
    """`delay_ns` shows how late a frame is."""
    link = Link(20, ppm=0, jitter_us=1, seed=8)
    link.received_ns = link.true_ns.astype(np.int64) + COMPLETE_NS + LEAST_DELAY_NS
    clock = DeviceClock(COMPLETE_NS)
    for t, r in zip(link.timestamp_us[:-1], link.received_ns[:-1], strict=True):
        clock.map(int(t), int(r))
        assert abs(clock.delay_ns) < 10_000
    clock.map(int(link.timestamp_us[-1]), int(link.received_ns[-1]) + 30_000_000)
    assert clock.delay_ns == pytest.approx(30e6, abs=10_000)


@pytest.mark.parametrize("rate_hz", [1, 20, 500])
@pytest.mark.parametrize("rate", [1e-3, 0.5, 0.9, 1.1, 1.7, 2.0, 10.0, 125.0, 1000.0])
def test_wrong_rate(rate: float, rate_hz: int) -> None:
    """A clock in another unit, or too fast or slow, is given up within seconds: times are those of arrival."""
    clock = DeviceClock(COMPLETE_NS)
    settled, frames = 15 * rate_hz, 17 * rate_hz
    for i in range(frames):
        true_ns = 7_000_000_000_000 + i * 1_000_000_000 // rate_hz
        t_ns = clock.map(round(i * rate / rate_hz * 1e6), true_ns + COMPLETE_NS)
        assert true_ns - 5_000_000_000 < t_ns < true_ns + 1_100_000_000, (i, t_ns - true_ns)
        if i >= settled:
            assert t_ns == true_ns
            assert clock.delay_ns == 0
            assert clock.fault
    named = re.search(r"runs at (\S+) times", clock.fault or "")
    assert named
    assert float(named[1]) == pytest.approx(rate, rel=0.05)


def test_clock_stands_still() -> None:
    """A clock that stands still is named, and times are those of arrival."""
    clock = DeviceClock(COMPLETE_NS)
    for i in range(1000):
        assert clock.map(5, 8_000_000 * i + COMPLETE_NS) == 8_000_000 * i
    assert "stands still" in (clock.fault or "")


def test_rate_mended() -> None:
    """A clock that runs right again is trusted again, after 30 s."""
    clock = DeviceClock(COMPLETE_NS)
    timestamp_us, fault = 0, ""
    for i in range(125 * 80):
        timestamp_us += 16_000 if i < 125 * 10 else 8_000
        clock.map(timestamp_us, 8_000_000 * i + COMPLETE_NS)
        fault = clock.fault or fault
    assert fault
    assert clock.fault is None


@pytest.mark.parametrize("ppm", [-900.0, 0.0, 900.0])
def test_busy_computer(ppm: float) -> None:
    """A computer that often stalls for up to two seconds does not cost a good clock its trust."""
    link = Link(60, ppm=ppm, jitter_us=500, seed=9)
    rng = np.random.default_rng(9)
    for at in np.cumsum(rng.integers(300, 1200, 8)):
        for k in range(8):  # so many frames wait in the device: it drops the others
            link.received_ns[at + k :][:1] += int(rng.integers(100_000_000, 2_000_000_000))
    link.received_ns = np.maximum.accumulate(link.received_ns)
    clock = DeviceClock(COMPLETE_NS)
    for t, r in zip(link.timestamp_us, link.received_ns, strict=True):
        clock.map(int(t), int(r))
        assert clock.fault is None


@pytest.mark.parametrize("rate", [2.0, 0.5, 1e-3, 1e3])
def test_taps(scene: Callable[[str], Recording], model: Model, rate: float) -> None:
    """No tap is lost to a clock at a wrong rate, from the first frame on: each is found, and young for subscribers."""
    taps = scene("tap")
    assert taps.contacts_mm is not None
    frames, contacts_mm = np.tile(taps.frames, (2, 1, 1)), np.tile(taps.contacts_mm, (2, 1, 1))
    begins = np.flatnonzero(np.diff(np.isfinite(contacts_mm[:, 0, 0]).astype(int)) == 1)
    clock, pipeline = DeviceClock(COMPLETE_NS), Pipeline(taps.acquisition, model, Settings())
    found: Counter[str] = Counter()
    for i, counts in enumerate(frames):
        received_ns = 7_000_000_000_000 + i * 8_000_000 + COMPLETE_NS
        t_ns = clock.map(round(i * 8000 * rate), received_ns)
        contacts = pipeline.process(Frame(counts, i, t_ns, received_ns)).contacts
        if received_ns - t_ns < MAX_AGE_S * 1e9:
            found.update(contact.phase for contact in contacts)
    assert clock.fault
    assert found["down"] == found["up"] == len(begins) > 10
