"""Whatever a device does, in whatever order: each of its numbers is a frame, lost or corrupt, and only one of these."""

from __future__ import annotations

import errno
import time
from itertools import pairwise
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.processes import PATIENCE_S
from tests.system.usb.backend import FakeBus, FakeDaq, Transfer
from tests.system.usb.reader import QUICK, Reader
from touchd.config.schema import DeviceSettings
from touchd.sources.usb import open_usb
from touchd.sources.usb_protocol import Info
from touchd.sources.usb_stream import acquisition_of

SMALL = Info(channels=2, samples=30, sample_rate_hz=250_000, min_frame_rate_hz=10)
SIZE = SMALL.frame_bytes
Action = tuple[str, Any]

actions: st.SearchStrategy[Action] = st.one_of(
    st.tuples(st.just("frame"), st.integers(0, 2**32)),
    st.tuples(st.just("flip"), st.integers(0, SIZE * 8 - 1)),
    st.tuples(st.just("cut"), st.integers(1, SIZE - 1)),
    st.tuples(st.just("splice"), st.integers(9, SIZE - 1)),  # behind the first byte in which the two differ
    st.tuples(st.just("skip"), st.integers(1, 1000)),
    st.tuples(st.just("error"), st.sampled_from([errno.EPIPE, errno.ETIMEDOUT])),
    st.tuples(st.just("overflow"), st.just(0)),
    st.tuples(st.just("empty"), st.just(0)),
)
connections = st.lists(st.lists(actions, max_size=12), min_size=1, max_size=3)


def transfers_of(daq: FakeDaq, todo: list[Action], sent: dict[str, int], frames: list[bytes]) -> list[Transfer]:
    """What the device sends on one connection, counted; it begins and ends with a valid frame."""
    transfers: list[Transfer] = []

    def frame(seed: int) -> bytes:
        samples = (seed % 251).to_bytes(1, "little") * (SIZE - 32)
        return daq.frame(samples, sequence=daq.sequence % 2**32)

    for kind, detail in [("frame", 1), *todo, ("frame", 2)]:
        if kind == "frame":
            data = frame(detail)
            frames.append(data[32:])
            transfers.append(data)
        elif kind == "flip":
            bad = bytearray(frame(3))
            bad[detail // 8] ^= 1 << detail % 8
            transfers.append(bytes(bad))
            sent["corrupt"] += 1
        elif kind == "cut":
            transfers.append(frame(4)[:detail])
            sent["corrupt"] += 1
        elif kind == "splice":  # two frames, and neither arrives
            transfers.append(frame(5)[:detail] + frame(6)[detail:])
            sent["corrupt"] += 1
            sent["lost"] += 1
        elif kind == "skip":
            daq.sequence += detail
            sent["lost"] += detail
        elif kind == "overflow":
            frame(7)
            transfers.append(errno.EOVERFLOW)
            sent["corrupt"] += 1
        else:
            transfers.append(detail if kind == "error" else b"")
    return transfers


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(lives=connections, first=st.integers(0, 2**32 - 1))
def test_any_device(lives: list[list[Action]], first: int) -> None:
    """Each number is a frame, lost or corrupt, only one of these, and frames come in order."""
    daq = FakeDaq(SMALL)
    daq.sequence = first
    sent = {"corrupt": 0, "lost": 0}
    frames: list[bytes] = []
    rest = [transfers_of(daq, life, sent, frames) for life in lives]
    total = len(frames)

    def send() -> None:
        if rest:
            daq.send(*rest.pop(0), *([errno.ENODEV] if rest else []))

    daq.started = send
    wanted = DeviceSettings(stall_s=10, queue_frames=500)
    source = open_usb(wanted, acquisition_of(SMALL), backend=FakeBus(daq), waits=QUICK)
    reader = Reader(source)
    try:
        until = time.monotonic() + PATIENCE_S
        while len(reader.frames) < total:
            reader.step()
            assert time.monotonic() < until, (len(reader.frames), total, source.tally)
    finally:
        source.close()
    assert [frame.counts.T.astype("<i2").tobytes() for frame in reader.frames] == frames
    numbers = reader.sequence
    assert all(b > a for a, b in pairwise(numbers))
    tally = source.tally
    assert (tally.corrupt, tally.lost, tally.behind, tally.withheld) == (sent["corrupt"], sent["lost"], 0, {})
    assert numbers[-1] - numbers[0] + 1 == total + tally.corrupt + tally.lost
    assert reader.states.count("lost") == len(lives) - 1
