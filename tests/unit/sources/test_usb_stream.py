"""`UsbDaq` turns transfers into frames: it reads each valid frame once, in order, and counts or clears each fault."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from touchd.sources import usb_stream
from touchd.sources.daq import DaqFrame, DaqGone
from touchd.sources.usb_protocol import SEQUENCE_SPAN, Flag, Header, Info, Request, build_frame
from touchd.sources.usb_stream import EndpointHalted, RequestRefused, TransferOverflow, UsbDaq

INFO = Info(channels=2, samples=3, sample_rate_hz=250_000)
HALT, OVERFLOW = EndpointHalted(), TransferOverflow()
Transfer = bytes | Exception | None


class Cable:
    """A connection that plays transfers, and keeps what it is asked for."""

    info, serial = INFO, "SN1"

    def __init__(self, transfers: Sequence[Transfer] = (), packet_bytes: int = 64) -> None:
        self.packet_bytes = packet_bytes
        self.transfers = list(transfers)
        self.asked: list[str] = []
        self.refuses: tuple[Request, ...] = ()

    def command(self, request: Request, value: int = 0) -> None:
        self.asked.append(f"{request.name} {value}")
        if request in self.refuses:
            raise RequestRefused(f"refuses {request.name}")

    def fill(self, buffer: array[int], timeout_ms: int) -> int | None:
        self.asked.append(f"read within {timeout_ms} ms")
        transfer = self.transfers.pop(0) if self.transfers else None
        if isinstance(transfer, Exception):
            raise transfer
        if transfer is not None:
            buffer[: len(transfer)] = array("B", transfer)
        return None if transfer is None else len(transfer)

    def clear_halt(self) -> None:
        self.asked.append("clear halt")

    def reset(self) -> None:
        self.asked.append("reset")

    def close(self) -> None:
        self.asked.append("close")


@pytest.fixture(autouse=True)
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usb_stream, "HALT_PAUSE_S", 0.0)


def frame(sequence: int, flags: int = 0) -> bytes:
    samples = struct.pack("<6h", *(100 * s + c for s in range(3) for c in range(2)))
    return build_frame(INFO, Header(sequence, 8000 * sequence, flags), samples)


def read_all(daq: UsbDaq, cable: Cable) -> list[tuple[DaqFrame, int]]:
    """Every frame, with the corrupt ones that were counted up to it."""
    found = []
    read = None
    while cable.transfers or read is not None:
        read = daq.read(0.1)
        if read is not None:
            found.append((read, daq.corrupt))
    return found


def numbers(cable: Cable) -> tuple[list[int], int]:
    daq = UsbDaq(cable)
    return [read.sequence for read, _ in read_all(daq, cable)], daq.corrupt


def test_a_frame_is_decoded() -> None:
    """Counts come as (channels, samples), with the device's number and time."""
    cable = Cable([frame(7)])
    read = UsbDaq(cable).read(0.1)
    assert read is not None
    assert read.counts.tolist() == [[0, 100, 200], [1, 101, 201]]
    assert (read.sequence, read.timestamp_us, read.clipped, read.withheld) == (7, 56_000, False, "")
    assert cable.asked == ["read within 100 ms"]


def test_a_frame_is_not_copied() -> None:
    """The counts of a frame that fills its transfer are a view of the transfer's memory."""
    cable = Cable([frame(0), frame(1)])
    daq = UsbDaq(cable)
    first, second = daq.read(0.1), daq.read(0.1)
    assert first is not None
    assert second is not None
    assert np.shares_memory(first.counts, second.counts)


@pytest.mark.parametrize(
    ("flags", "clipped", "withheld"),
    [
        (Flag.CLIPPED, True, ""),
        (Flag.DROPPED_BEFORE, False, ""),
        (Flag.TEST_PATTERN | Flag.CLIPPED, True, "test_pattern"),
        (Flag.EMITTER_FAULT, False, "emitter_fault"),
        (Flag.EMITTER_FAULT | Flag.TEST_PATTERN, False, "test_pattern"),
    ],
)
def test_flags_say_what_a_frame_is_good_for(flags: int, clipped: bool, withheld: str) -> None:
    """A frame that shows no plate names the reason."""
    read = UsbDaq(Cable([frame(0, flags)])).read(0.1)
    assert read is not None
    assert (read.clipped, read.withheld) == (clipped, withheld)


def test_corrupt_frames_count_before_the_frame_behind_them() -> None:
    """At each frame `corrupt` holds what came before it and no more, so that nothing counts as lost as well."""
    cable = Cable([frame(0), b"x" * 10 + frame(2), b"x" * 60, frame(4) + b"x" * 3, frame(6)[:-1]])
    daq = UsbDaq(cable)
    found = [(read.sequence, corrupt) for read, corrupt in read_all(daq, cable)]
    assert found == [(0, 0), (2, 1), (4, 3)]
    assert daq.corrupt == 5


@given(st.lists(st.integers(0, 100), min_size=1, max_size=6), st.sampled_from([16, 32, 48]))
def test_frames_do_not_depend_on_how_transfers_cut_them(gaps: list[int], size: int) -> None:
    """A transfer may hold no whole frame, one, or parts of two: each frame is read once, and the same are corrupt."""
    stream = b"".join(b"x" * gap + frame(i) for i, gap in enumerate(gaps))
    cable = Cable([stream[i : i + size] for i in range(0, len(stream), size)], packet_bytes=16)
    daq = UsbDaq(cable)
    found = [(read.sequence, corrupt) for read, corrupt in read_all(daq, cable)]
    lengths = [-(-gap // INFO.frame_bytes) for gap in gaps]
    assert found == [(i, sum(lengths[: i + 1])) for i in range(len(gaps))]


def test_a_counter_that_wraps_goes_on() -> None:
    """The number is unwrapped; a small step back stays one."""
    cable = Cable([frame(n % SEQUENCE_SPAN) for n in (SEQUENCE_SPAN - 1, SEQUENCE_SPAN, SEQUENCE_SPAN - 1)])
    assert numbers(cable) == ([SEQUENCE_SPAN - 1, SEQUENCE_SPAN, SEQUENCE_SPAN - 1], 0)


def test_an_overflow_is_a_corrupt_frame() -> None:
    """The transfer is lost, and the next frame is read."""
    assert numbers(Cable([frame(0), OVERFLOW, frame(2)])) == ([0, 2], 1)


def test_a_halt_is_cleared_and_logged_ever_less() -> None:
    """Of 10 halts the 1st, 2nd, 4th and 8th are logged, and the frame after each halt is read."""
    cable = Cable([transfer for i in range(10) for transfer in (HALT, frame(i))])
    with capture_logs() as lines:
        assert numbers(cable) == (list(range(10)), 0)
    assert cable.asked.count("clear halt") == 10
    assert [line["halts"] for line in lines] == [1, 2, 4, 8]


def test_a_stream_starts_empty() -> None:
    """STOP, then everything is discarded, then START with the rate; the first frame may have any number."""
    cable = Cable([frame(1), frame(2)])
    daq = UsbDaq(cable)
    daq.start(125)
    drain = ["read within 10 ms"] * 3
    assert cable.asked == ["STOP 0", *drain, "START 125"]
    cable.transfers = [frame(SEQUENCE_SPAN - 1)]
    read = daq.read(0.1)
    assert read is not None
    assert read.sequence == SEQUENCE_SPAN - 1


def test_a_restart_clears_a_halt_first() -> None:
    """A device that never stops sending delays it by 32 reads at most."""
    cable = Cable()
    daq = UsbDaq(cable)
    daq.start(125)
    cable.asked.clear()
    cable.transfers = [frame(0)] * 100
    daq.start(125)
    assert cable.asked == ["clear halt", "STOP 0", *["read within 10 ms"] * 32, "START 125"]


def test_refused_requests() -> None:
    """A refused START ends the connection; a refused STOP is ignored."""
    cable = Cable()
    cable.refuses = (Request.STOP, Request.START)
    with pytest.raises(DaqGone, match="it refuses START"):
        UsbDaq(cable).start(125)
    UsbDaq(cable).stop()


def test_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """SET_RATE is sent within the device's limits, and never to a device without it."""
    cable = Cable()
    UsbDaq(cable).set_rate(50)
    assert cable.asked == []
    monkeypatch.setattr(Cable, "info", replace(INFO, capabilities=1, min_frame_rate_hz=20))
    daq = UsbDaq(cable)
    daq.set_rate(50)
    daq.set_rate(10)
    cable.refuses = (Request.SET_RATE,)
    daq.set_rate(30)
    assert cable.asked == ["SET_RATE 50", "SET_RATE 20", "SET_RATE 30"]
