"""The device in software keeps to the protocol, and is late, full and faulty as a real one is."""

from __future__ import annotations

import errno
from dataclasses import replace
from itertools import count
from typing import Any

import pytest

from tests.unit.service.bench import Clock
from touchd.errors import GadgetError
from touchd.gadget.device import BACKLOG, COMMANDS, Gadget
from touchd.sources.usb_protocol import Flag, FrameReader, Header, Info, Request, Status, build_status, parse_info

INFO = Info(
    channels=2, samples=250, sample_rate_hz=250_000, min_frame_rate_hz=10, max_frame_rate_hz=1000, capabilities=1
)
IN, OUT = 0xC0, 0x40
PERIOD_NS = 10_000_000
COMPLETE_NS = 1_000_000


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def gadget(clock: Clock) -> Gadget:
    numbered = (i.to_bytes(2, "little") * 500 for i in count())
    gadget = Gadget(INFO, numbered, clock)
    clock.now_ns += 5_000_000
    return gadget


def start(gadget: Gadget) -> None:
    assert gadget.control(OUT, Request.START, 100, 0) == b""


def fetch(gadget: Gadget) -> tuple[Header, int]:
    """The next frame's header, and which samples it holds."""
    data = gadget.next_transfer()
    assert isinstance(data, bytes)
    ((header, samples),) = FrameReader(INFO).feed(memoryview(data), ended=True)
    return header, int.from_bytes(samples[:2], "little")


def test_it_says_what_it_is_and_what_it_counts(gadget: Gadget, clock: Clock) -> None:
    assert parse_info(gadget.control(IN, Request.GET_INFO, 0, 64) or b"") == INFO
    start(gadget)
    clock.now_ns += COMPLETE_NS
    fetch(gadget)
    assert gadget.control(IN, Request.GET_STATUS, 0, 32) == build_status(Status(frames_sent=1, running=True))


def test_it_answers_no_more_than_it_is_asked_for(gadget: Gadget) -> None:
    assert gadget.control(IN, Request.GET_INFO, 0, 8) == b"TDAQ\1\0\x20\0"


@pytest.mark.parametrize(
    "request_",
    [(IN, 0x01 + 0x10, 0, 64), (OUT, 0x01, 0, 0), (0x80, 0x06, 0x100, 18), (OUT, 2, 9, 0), (OUT, 2, 1001, 0)],
)
def test_it_stalls_what_it_does_not_know_or_cannot_do(gadget: Gadget, request_: tuple[int, int, int, int]) -> None:
    assert gadget.control(*request_) is None
    assert not gadget.running


def test_a_frame_is_sent_when_its_last_sample_is_taken_at_the_rate_asked_for(gadget: Gadget, clock: Clock) -> None:
    assert gadget.wait_s() == float("inf")
    start(gadget)
    begun_ns = clock.now_ns
    for i in range(5):
        due_ns = begun_ns + i * PERIOD_NS + COMPLETE_NS
        assert gadget.wait_s() == pytest.approx((due_ns - clock.now_ns) * 1e-9)
        clock.now_ns = due_ns - 1
        assert gadget.next_transfer() is None
        clock.now_ns = due_ns
        header, samples = fetch(gadget)
        assert (header.sequence, samples) == (i, i)
        assert header.timestamp_us == 5000 + i * 10_000
        assert header.flags == 0


def test_a_host_that_is_a_little_late_gets_every_frame(gadget: Gadget, clock: Clock) -> None:
    start(gadget)
    clock.now_ns += COMPLETE_NS + BACKLOG * PERIOD_NS
    assert [fetch(gadget)[0].sequence for _ in range(BACKLOG + 1)] == list(range(BACKLOG + 1))
    assert gadget.overruns == 0
    assert gadget.next_transfer() is None


def test_a_host_that_is_too_late_loses_the_oldest_and_is_told(gadget: Gadget, clock: Clock) -> None:
    start(gadget)
    clock.now_ns += COMPLETE_NS + (BACKLOG + 3) * PERIOD_NS
    header, samples = fetch(gadget)
    assert (header.sequence, samples, header.flags) == (3, 3, Flag.DROPPED_BEFORE)
    assert gadget.overruns == 3
    header, _ = fetch(gadget)
    assert (header.sequence, header.flags) == (4, 0)


def test_a_scene_waits_for_a_host_that_was_away(gadget: Gadget, clock: Clock) -> None:
    start(gadget)
    clock.now_ns += COMPLETE_NS + 3600 * 10**9
    header, samples = fetch(gadget)
    assert (samples, gadget.overruns) == (0, 0)
    assert header.timestamp_us == 5000 + 3600 * 10**6


def test_stop_stops_and_start_goes_on(gadget: Gadget, clock: Clock) -> None:
    start(gadget)
    clock.now_ns += COMPLETE_NS
    fetch(gadget)
    assert gadget.control(OUT, Request.STOP, 0, 0) == b""
    clock.now_ns += 10 * PERIOD_NS
    assert gadget.next_transfer() is None
    start(gadget)
    clock.now_ns += COMPLETE_NS
    header, _ = fetch(gadget)
    assert (header.sequence, header.flags) == (1, 0)


def test_when_the_recording_ends_so_does_the_stream(clock: Clock) -> None:
    gadget = Gadget(INFO, iter([bytes(1000)]), clock)
    start(gadget)
    clock.now_ns += COMPLETE_NS + PERIOD_NS
    assert isinstance(gadget.next_transfer(), bytes)
    assert gadget.next_transfer() is None
    assert not gadget.running


@pytest.mark.parametrize("fault", ["corrupt", "short"])
def test_a_faulty_frame_fails_the_checks_and_the_next_is_whole(gadget: Gadget, clock: Clock, fault: str) -> None:
    start(gadget)
    gadget.command(fault)
    clock.now_ns += COMPLETE_NS
    data: Any = gadget.next_transfer()
    reader = FrameReader(INFO)
    assert list(reader.feed(memoryview(data), ended=True)) == []
    assert reader.corrupt == 1
    clock.now_ns += PERIOD_NS
    assert fetch(gadget)[0].sequence == 1


def test_halt_and_silence_are_made_on_command(gadget: Gadget, clock: Clock) -> None:
    start(gadget)
    clock.now_ns += COMPLETE_NS
    gadget.command("halt")
    assert gadget.next_transfer() == errno.EPIPE
    gadget.command("silent")
    assert (gadget.next_transfer(), gadget.wait_s()) == (None, float("inf"))
    gadget.command("normal")
    assert fetch(gadget)[0].sequence == 0


def test_an_unknown_command_is_refused(gadget: Gadget) -> None:
    with pytest.raises(ValueError, match="dance"):
        gadget.command("dance")
    assert "dance" not in COMMANDS


@pytest.mark.parametrize("changed", [{"channels": 256}, {"samples": 65_536}, {"sample_rate_hz": 2**32}, {"bits": -1}])
def test_frames_beyond_the_protocol(changed: dict[str, Any]) -> None:
    """Frames that GET_INFO cannot describe are refused."""
    with pytest.raises(GadgetError, match="do not fit the protocol"):
        Gadget(replace(Info(channels=4, samples=250, sample_rate_hz=250_000), **changed), iter([]))


def test_set_rate(gadget: Gadget, clock: Clock) -> None:
    """SET_RATE arms the timer at once: the next chirp is one new period after the last, or now if that has passed."""
    start(gadget)
    clock.now_ns += COMPLETE_NS
    first, _ = fetch(gadget)
    assert gadget.control(OUT, Request.SET_RATE, 50, 0) == b""
    assert gadget.wait_s() == pytest.approx(0.020)
    clock.now_ns += 12_000_000
    assert gadget.control(OUT, Request.SET_RATE, 100, 0) == b""
    assert gadget.wait_s() == pytest.approx(0.001), "the period has passed: a chirp begins now"
    clock.now_ns += 500_000
    assert gadget.control(OUT, Request.SET_RATE, 500, 0) == b""
    assert gadget.wait_s() == pytest.approx(0.0005), "the frame in hand is finished"
    clock.now_ns += 500_000
    second, _ = fetch(gadget)
    assert (second.sequence, second.timestamp_us - first.timestamp_us) == (1, 13_000)
    assert gadget.wait_s() == pytest.approx(0.002)
    assert gadget.overruns == 0


@pytest.mark.parametrize(
    ("rate_hz", "expected"), [(50, [0, 2, 4, 6, 8]), (40, [0, 2, 5, 7, 10]), (200, [0, 1, 2, 3, 4])]
)
def test_scene_keeps_its_speed(gadget: Gadget, clock: Clock, rate_hz: int, expected: list[int]) -> None:
    """At a lower rate frames of the scene are left out; at a higher one it runs faster, for no frame comes twice."""
    start(gadget)
    clock.now_ns += COMPLETE_NS
    taken = [fetch(gadget)[1]]
    assert gadget.control(OUT, Request.SET_RATE, rate_hz, 0) == b""
    for _ in range(4):
        clock.now_ns += 10**9 // rate_hz
        taken.append(fetch(gadget)[1])
    assert taken == expected
    assert gadget.control(OUT, Request.SET_RATE, 100, 0) == b""
    clock.now_ns += PERIOD_NS
    assert fetch(gadget)[1] == expected[-1] + 1


def test_set_rate_refused(clock: Clock) -> None:
    """SET_RATE is stalled beyond the limits, while stopped, and by a device without the capability."""
    gadget = Gadget(INFO, iter([]), clock)
    assert gadget.control(OUT, Request.SET_RATE, 50, 0) is None
    start(gadget)
    assert gadget.control(OUT, Request.SET_RATE, 9, 0) is None
    older = Gadget(replace(INFO, capabilities=0), iter([]), clock)
    start(older)
    assert older.control(OUT, Request.SET_RATE, 50, 0) is None
    assert older.rate_hz == 100
