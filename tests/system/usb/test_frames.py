"""Each frame of the device is read once, in order, or counted under the reason that it was not."""

from __future__ import annotations

import errno
import threading
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.system.usb.backend import FakeBus, FakeDaq, steady
from tests.system.usb.reader import INFO, QUICK, Read, wait
from touchd.sources.usb_protocol import Flag, Info, Request
from touchd.sources.usb_stream import acquisition_of


def samples(seed: int) -> bytes:
    return np.random.default_rng(seed).integers(-32768, 32768, 1000).astype("<i2").tobytes()


def test_frames(daq: FakeDaq, read: Read) -> None:
    """Frames arrive as they were sent, after START with the default rate."""
    sent = [samples(seed) for seed in range(5)]
    daq.started = lambda: daq.send(*[daq.frame(data) for data in sent])
    reader = read()
    reader.until_frames(5)
    for frame, data in zip(reader.frames, sent, strict=True):
        interleaved = np.frombuffer(data, "<i2").reshape(250, 4)
        np.testing.assert_array_equal(frame.counts, interleaved.T)
        assert frame.counts.dtype == np.int16
    assert reader.sequence == [0, 1, 2, 3, 4]
    assert reader.states == ["streaming"]
    assert daq.requests[-1] == (Request.START, 125)


def test_rate(daq: FakeDaq, read: Read) -> None:
    """START asks for `device.rate_hz`."""
    steady(daq)
    read(rate_hz=500).until_frames(1)
    assert (Request.START, 500) in daq.requests


@pytest.mark.parametrize("capabilities", [0, 1])
def test_other_rate(bus: FakeBus, read: Read, capabilities: int) -> None:
    """SET_RATE asks for another rate while frames come, and again once the stream restarts; not without it."""
    daq = bus.daqs[0] = FakeDaq(replace(INFO, capabilities=capabilities))
    steady(daq)
    reader = read(stall_s=0.1)
    reader.until_frames(5)
    reader.source.set_rate(50)
    reader.until(lambda: [name for name, _ in daq.requests].count(Request.START) == 2)
    reader.until_frames(10)
    assert daq.rate_hz == (50 if capabilities else 125)
    asked = [value for name, value in daq.requests if name in (Request.START, Request.SET_RATE)]
    assert asked[:4] == ([125, 50, 125, 50] if capabilities else [125, 125])
    assert reader.sequence == list(range(10))


def test_leftovers(daq: FakeDaq, read: Read) -> None:
    """What an earlier stream left behind is discarded."""
    daq.send(*[daq.frame(sequence=7) for _ in range(3)])
    steady(daq)
    reader = read()
    reader.until_frames(5)
    assert reader.sequence == [8, 9, 10, 11, 12]


def test_times(daq: FakeDaq, read: Read) -> None:
    """`t_ns` follows the device's clock, and the first frame began one frame before it was complete."""
    steady(daq, 50)
    reader = read()
    reader.until_frames(50)
    t_ns = np.array([frame.t_ns for frame in reader.frames])
    received_ns = np.array([frame.received_ns for frame in reader.frames])
    assert (np.diff(t_ns) > 0).all()
    # All came at once, though they were sampled 8 ms apart: by arrival they would lie within a millisecond or so.
    assert np.diff(t_ns).min() > 7e6
    assert t_ns[0] == received_ns[0] - 1_000_000


def test_counter_wraps(daq: FakeDaq, read: Read) -> None:
    """Numbers go on over the wrap of the device's counter."""
    daq.sequence = 2**32 - 3
    daq.started = lambda: daq.send(*[daq.frame(sequence=(2**32 - 3 + i) % 2**32, timestamp_us=i) for i in range(6)])
    reader = read()
    reader.until_frames(6)
    assert reader.sequence == [2**32 - 3 + i for i in range(6)]
    assert reader.source.tally.lost == 0


def test_losses(daq: FakeDaq, read: Read) -> None:
    """A skipped frame is lost, a damaged one corrupt, and none is both."""

    def send() -> None:
        frames = [daq.frame() for _ in range(20)]
        bad = bytearray(frames[3])
        bad[500] ^= 0x10
        frames[3] = bytes(bad)
        del frames[10:14]
        daq.send(*frames)

    daq.started = send
    reader = read()
    reader.until_frames(15)
    tally = reader.source.tally
    assert (tally.lost, tally.corrupt, tally.behind) == (4, 1, 0)
    assert reader.sequence == [0, 1, 2, *range(4, 10), *range(14, 20)]


@pytest.mark.parametrize("flag", [Flag.TEST_PATTERN, Flag.EMITTER_FAULT])
def test_withheld(daq: FakeDaq, read: Read, flag: Flag) -> None:
    """A test pattern, and a chirp that was not sent, count by their reason and are not passed on."""
    daq.started = lambda: daq.send(daq.frame(), daq.frame(flags=flag), daq.frame())
    reader = read()
    reader.until_frames(2)
    assert reader.sequence == [0, 2]
    assert reader.source.tally.withheld == {flag.name.lower(): 1} if flag.name else None
    assert reader.source.tally.lost == 0


def test_clipped(daq: FakeDaq, read: Read) -> None:
    """A clipped frame counts and is passed on."""
    daq.started = lambda: daq.send(daq.frame(), daq.frame(flags=Flag.CLIPPED), daq.frame())
    reader = read()
    reader.until_frames(3)
    assert reader.source.tally.clipped == 1


def test_late(daq: FakeDaq, read: Read) -> None:
    """A frame later than the quickest ones by more than a period counts as late."""
    begun_ns = time.monotonic_ns()

    def frame(late_us: int = 0) -> bytes:
        return daq.frame(timestamp_us=1_000_000 + (time.monotonic_ns() - begun_ns) // 1000 - late_us)

    daq.started = lambda: daq.send(*[frame() for _ in range(3)])
    reader = read(rate_hz=1000)
    reader.until_frames(3)
    while not reader.source.tally.late and len(reader.frames) < 100:  # much later, its clock might be slow instead
        threading.Event().wait(0.03)
        daq.send(frame(late_us=20_000))
        reader.until_frames(len(reader.frames) + 1)
    assert reader.source.tally.late >= 1


def test_behind(daq: FakeDaq, read: Read) -> None:
    """A reader that falls behind loses the oldest frames, which count as behind and not as lost."""
    reader = read(queue_frames=4)
    steady(daq, 1)
    reader.until(lambda: daq.running)
    daq.send(*[daq.frame() for _ in range(100)])
    tally = reader.source.tally
    wait(lambda: tally.behind)
    reader.until(lambda: len(reader.frames) + tally.behind == daq.sequence)
    assert tally.lost == 0, "dropped here is not lost there"
    assert reader.sequence[-1] == daq.sequence - 1, "the newest is kept"
    assert all(b > a for a, b in pairwise(reader.sequence))


@pytest.mark.parametrize(
    ("between", "corrupt"),
    [
        ([b""], 0),
        ([b"x" * 100], 1),
        ([b"x" * 512, b"x" * 100], 1),
        ([b"x" * 5000], 3),
        ([b"TDFR" + bytes(60)], 1),
        ([errno.EOVERFLOW], 1),
        ([errno.ETIMEDOUT], 0),
        ([errno.EPIPE], 0),
        ([errno.EPIPE, errno.EPIPE, b"TDFR", errno.EPIPE], 1),
    ],
)
def test_between_frames(daq: FakeDaq, read: Read, between: list[bytes | int], corrupt: int) -> None:
    """Rubbish, halts, overflows and time-outs between two frames cost neither of them, and change no state."""
    daq.started = lambda: daq.send(daq.frame(), *between, daq.frame())
    reader = read()
    reader.until_frames(2)
    assert reader.sequence == [0, 1]
    assert reader.source.tally.corrupt == corrupt
    assert reader.source.tally.lost == 0
    assert reader.states == ["streaming"], "none of these is a change of state"
    assert daq.cleared == between.count(errno.EPIPE)


def test_frame_in_pieces(daq: FakeDaq, read: Read) -> None:
    """A read that times out within a frame does not cost the frame."""

    def send() -> None:
        daq.send(daq.frame()[:1024])

    daq.started = send
    reader = read()
    reader.until(lambda: daq.running and daq.idle)
    whole = daq.frame(sequence=0)
    threading.Event().wait(3 * QUICK.read_s)  # the read has timed out within the frame
    daq.send(whole[1024:])
    reader.until_frames(1)
    assert reader.source.tally.corrupt == 0


def test_full_last_packet(bus: FakeBus, read: Read) -> None:
    """A frame that fills its last packet ends with an empty one, and the next frame is read whole."""
    info = Info(channels=4, samples=252, sample_rate_hz=250_000)
    assert info.frame_bytes % 512 == 0
    daq = FakeDaq(info)
    bus.daqs[:] = [daq]
    daq.started = lambda: daq.send(*[part for _ in range(5) for part in (daq.frame(), b"")])
    reader = read(acquisition_of(info))
    reader.until_frames(5)
    assert (reader.source.tally.corrupt, reader.source.tally.lost) == (0, 0)
