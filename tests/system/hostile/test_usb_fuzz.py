"""A device made up by somebody else costs no thread, memory or descriptor: 20,000 transfers, 20,000 descriptions."""

from __future__ import annotations

import errno
import logging
import random
import time
from collections import Counter

import pytest
import structlog

from tests.processes import PATIENCE_S
from tests.system.hostile.usage import bounded
from tests.system.usb.backend import FakeBus, FakeDaq, Transfer
from touchd.config.schema import DeviceSettings
from touchd.errors import DeviceLost
from touchd.frame import Acquisition
from touchd.localization.model import Model
from touchd.sources import usb_stream
from touchd.sources.daq import Daq, DaqAbsent, DeviceSearch, Waits, open_first
from touchd.sources.usb import candidates, open_usb
from touchd.sources.usb_protocol import Info, Request, build_info
from touchd.sources.usb_stream import acquisition_of

INFO = Info(channels=4, samples=250, sample_rate_hz=250_000, min_frame_rate_hz=10)
MOST_GROWTH_KB = 16_000
AT_ONCE = Waits(read_s=0.01, retry_s=1e-4, max_retry_s=1e-3)


@pytest.fixture(autouse=True)
def no_log() -> None:
    """Nothing is printed, or kept, of thousands of lines."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))


@pytest.fixture
def count(request: pytest.FixtureRequest) -> int:
    return 20_000 if request.config.getoption("--hostile") == "full" else 1000


# -- transfers --------------------------------------------------------------------------------------


def frame(rng: random.Random, daq: FakeDaq) -> bytes:
    """A valid frame; its number and time are any now and then."""
    fields = {} if rng.random() < 0.7 else {"sequence": rng.getrandbits(32), "timestamp_us": rng.getrandbits(64)}
    flags = rng.getrandbits(8) if rng.random() < 0.2 else 0
    return daq.frame(rng.randbytes(8) * 250, flags=flags, **{"sequence": daq.sequence % 2**32} | fields)


def flip(rng: random.Random, data: bytes) -> bytes:
    spoiled = bytearray(data)
    for _ in range(rng.randint(1, 40)):
        spoiled[rng.randrange(len(spoiled))] = rng.getrandbits(8)
    return bytes(spoiled)


def transfer(rng: random.Random, daq: FakeDaq) -> Transfer:
    """What no device of ours sends, or a frame."""
    kind = rng.randrange(10)
    if kind == 0:
        return rng.randbytes(rng.randrange(4096))
    if kind == 1:
        return flip(rng, frame(rng, daq))
    if kind == 2:
        return frame(rng, daq)[: rng.randrange(2032)]
    if kind == 3:
        return frame(rng, daq)[rng.randrange(2032) :] + frame(rng, daq)
    if kind == 4:
        return b"TDFR" * rng.randrange(1000)  # begins a frame at every fourth byte
    if kind == 5:
        return bytes(512 * rng.randrange(5))  # whole packets: the transfer goes on
    if kind == 6 and rng.random() < 0.05:
        return rng.choice([errno.EPIPE, errno.EOVERFLOW, errno.EIO, errno.ENODEV, errno.EPROTO, errno.ENOMEM])
    return frame(rng, daq)


def test_transfers(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """After any transfers the source still reads the frames that follow, and its times increase."""
    monkeypatch.setattr(usb_stream, "HALT_PAUSE_S", 0.0)
    rng, sent = random.Random(1), Counter[str]()
    daq = FakeDaq(INFO)

    def next_transfer() -> Transfer | None:
        made = transfer(rng, daq)
        sent["error" if isinstance(made, int) else "transfer"] += 1
        return made if sent.total() <= count else daq.frame(bytes(2000), sequence=daq.sequence % 2**32)

    daq.source = next_transfer
    with bounded("transfers", MOST_GROWTH_KB):
        source = open_usb(DeviceSettings(stall_s=10.0), acquisition_of(INFO), backend=FakeBus(daq), waits=AT_ONCE)
        frames, last_ns, until = 0, 0, time.monotonic() + PATIENCE_S
        while sent.total() < count + 100:
            assert time.monotonic() < until, (sent, frames)
            read = source.read(0.1)
            source.changes()
            if read is not None:
                frames += 1
                assert read.t_ns > last_ns
                last_ns = read.t_ns
        source.close()
        daq.source = lambda: None
    print(dict(sent), f"{frames} frames read", source.tally)
    assert frames > 0


# -- descriptions -----------------------------------------------------------------------------------


def spoil(rng: random.Random, daq: FakeDaq) -> None:
    """Give a device an answer to GET_INFO, and now and then descriptors, that no device of ours has."""
    answer = bytearray(build_info(INFO))
    for _ in range(rng.randint(0, 3)):
        at = rng.randrange(4, 48) if rng.random() < 0.9 else rng.randrange(64)
        answer[at] = rng.choice([0, 1, 127, 128, 255, rng.getrandbits(8)])
    if rng.random() < 0.1:
        at, size = rng.randrange(8, 44), rng.choice([1, 2, 4])
        answer[at : at + size] = rng.choice([b"\0", b"\xff"]) * size
    daq.answer = bytes(answer[: rng.choice([64] * 8 + [rng.randrange(65)])])
    if rng.random() < 0.1:
        daq.endpoint.wMaxPacketSize = rng.choice([0, 1, 3, 8, 1023, 65_535])
    if rng.random() < 0.05:
        daq.endpoint.bEndpointAddress, daq.endpoint.bmAttributes = rng.getrandbits(8), rng.getrandbits(8)
    if rng.random() < 0.05:
        daq.strings[3] = "".join(chr(rng.choice([0, 10, 0xFFFD, 0x41])) for _ in range(rng.randrange(120)))
    if rng.random() < 0.05:
        daq.control_errors[rng.choice(list(Request))] = rng.choice([errno.EPIPE, errno.EIO, errno.ETIMEDOUT])


def test_descriptions(model: Model, count: int) -> None:
    """Any device is opened or skipped with a reason, closed either way, and the one behind it is found."""
    rng, outcomes = random.Random(2), Counter[str]()

    def find(check: bool) -> Daq:
        """As the daemon does, or as `touchd record`, for which the device decides."""
        if not check:
            return open_first(lambda: candidates(DeviceSettings(), bus))
        return DeviceSearch(lambda: candidates(DeviceSettings(), bus), DeviceSettings(), model.check).find()

    with bounded("descriptions", MOST_GROWTH_KB):
        for _ in range(count):
            daq, good = FakeDaq(INFO), FakeDaq(INFO, "GOOD")
            spoil(rng, daq)
            bus = FakeBus(daq)
            why = "opened"
            try:
                found = find(rng.random() < 0.7)
            except (DaqAbsent, DeviceLost) as refusal:
                why = str(refusal)
            else:
                assert isinstance(found.acquisition, Acquisition)
                found.close()
            assert why
            outcomes["opened" if why == "opened" else "skipped"] += 1
            bus.daqs.append(good)
            found = find(check=True)
            found.close()
            assert found.device.serial in ("GOOD", "SN0001", daq.strings[3])
            assert (daq.opened, good.opened) == (daq.closed, good.closed)
    print(dict(outcomes))
    assert outcomes["opened"]
    assert outcomes["skipped"]
