"""A running daemon hands its frames to programs of its own user, and never waits for one."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from touchd.errors import BusError, SourceError
from touchd.frame import Acquisition, Frame, Plate
from touchd.service import control as module
from touchd.service.control import Control, converse, send
from touchd.service.frame_feed import (
    COMMAND,
    MOST_LISTENERS,
    STUCK_NS,
    DaemonSource,
    FeedDescription,
    FrameFeed,
    open_daemon,
)

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
PLATE = Plate(width_mm=300, height_mm=200)
rng = np.random.default_rng(0)


def frame(number: int) -> Frame:
    return Frame(rng.integers(-9999, 9999, RIG.shape).astype(np.int16), number, 8_000_000 * number, 5)


@pytest.fixture
def feed() -> Iterator[FrameFeed]:
    feed = FrameFeed(lambda: FeedDescription(acquisition=RIG, rate_hz=125, source="usb", plate=PLATE))
    yield feed
    feed.close()


@pytest.fixture
def control(tmp_path: Path) -> Iterator[Control]:
    control = Control(tmp_path / "control")
    yield control
    control.close()


def ask(control: Control) -> tuple[socket.socket, list[str]]:
    """Ask for frames as `open_daemon` does, and have the daemon read the command."""
    mine = converse(control.path, COMMAND)
    return mine, control.poll()


def test_frames_arrive(control: Control, feed: FrameFeed) -> None:
    """Bit for bit, with their numbers and times, after what they are; the daemon's end is an error."""
    mine, said = ask(control)
    assert said == ["frames"]
    feed.add(control.listeners.pop())
    source = DaemonSource(mine)
    assert (source.acquisition, source.description.plate) == (RIG, PLATE)
    assert source.read(0.01) is None
    sent = [frame(number) for number in range(3)]
    for each in sent:
        feed.send(each)
    for each in sent:
        got = source.read(1.0)
        assert got is not None
        assert (got.sequence, got.t_ns, got.received_ns) == (each.sequence, each.t_ns, each.received_ns)
        assert (got.counts == each.counts).all()
    feed.close()
    with pytest.raises(SourceError, match="the daemon has ended"):
        source.read(1.0)
    source.close()


def test_keypad(control: Control) -> None:
    """A plate that becomes a keypad while it runs ends the streams; who asks again is told, and is served."""
    d = FeedDescription(acquisition=RIG, rate_hz=125, source="usb", plate=PLATE)
    said = [d]
    feed = FrameFeed(lambda: said[0])
    mine, _ = ask(control)
    feed.add(control.listeners.pop())
    source = DaemonSource(mine)
    assert not source.description.keypad
    feed.configured()
    assert source.read(0.01) is None
    said[0] = d.model_copy(update={"keypad": True})
    feed.configured()
    with pytest.raises(SourceError, match="its plate is a keypad now"):
        source.read(1.0)
    mine, _ = ask(control)
    feed.add(control.listeners.pop())
    again = DaemonSource(mine)
    assert again.description.keypad
    feed.configured()
    assert again.read(0.01) is None
    for each in (source, again, feed):
        each.close()


def test_slow_reader(control: Control, feed: FrameFeed) -> None:
    """A program that does not read loses frames; the daemon goes on, and what it reads later is whole."""
    mine, _ = ask(control)
    feed.add(control.listeners.pop())
    source = DaemonSource(mine)
    for number in range(5000):
        feed.send(frame(number))
    assert feed.listeners
    numbers = []
    while (got := source.read(0.05)) is not None:
        numbers.append(got.sequence)
    assert numbers == list(range(len(numbers)))
    assert 0 < len(numbers) < 5000
    feed.send(frame(5000))
    late = source.read(1.0)
    assert late is not None
    assert late.sequence == 5000
    source.close()
    feed.send(frame(5001))
    assert not feed.listeners, "who has left is forgotten"


def test_stopped_program(control: Control, feed: FrameFeed) -> None:
    """A program that was stopped and forgotten loses its place after a minute; one that reads now and then does not."""
    sources = []
    for _ in range(2):
        mine, _ = ask(control)
        feed.add(control.listeners.pop())
        sources.append(DaemonSource(mine))
    stopped, slow = sources
    one, period_ns = frame(0), 16_000_000
    for number in range(3 * STUCK_NS // period_ns):
        feed.send(replace(one, sequence=number, received_ns=number * period_ns))
        if number % 2000 == 0:
            assert slow.read(1.0) is not None
    assert len(feed.listeners) == 1
    with pytest.raises(SourceError, match="stood still"):
        list(iter(lambda: stopped.read(1.0), None))
    for each in sources:
        each.close()


def test_programs_that_gave_up(control: Control, feed: FrameFeed) -> None:
    """While the device is away for days no frame comes; programs that waited for one and left take nobody's place."""
    for _ in range(5 * MOST_LISTENERS):
        mine, _ = ask(control)
        feed.add(control.listeners.pop())
        DaemonSource(mine).close()
    assert len(feed.listeners) == 1


def test_few_at_once(control: Control, feed: FrameFeed) -> None:
    """One more than the most gets nothing, and learns so."""
    kept = []
    for _ in range(MOST_LISTENERS):
        kept.append(ask(control)[0])
        feed.add(control.listeners.pop())
    one_more, _ = ask(control)
    feed.add(control.listeners.pop())
    assert len(feed.listeners) == MOST_LISTENERS
    with pytest.raises(BusError, match="hands out no frames"):
        DaemonSource(one_more)
    for each in kept:
        each.close()


def test_another_user(control: Control, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who may switch the screen may not read frames, which can reveal a PIN."""
    real = module._unpack
    monkeypatch.setattr(module, "_unpack", lambda ancillary: (12345, real(ancillary)[1]))
    mine, said = ask(control)
    assert (said, control.listeners) == ([], [])
    with pytest.raises(BusError):
        DaemonSource(mine)
    send(control.path, "screen on")
    assert control.poll() == ["screen on"]


def test_wrong_sockets(control: Control) -> None:
    """Descriptors that belong to no command are closed, whatever they are."""
    before = len(os.listdir("/proc/self/fd"))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender, open("/dev/null") as nothing:
        sender.connect(str(control.path))
        for said, count in ((b"frames", 1), (b"frames", 2), (b"screen on", 3), (b"nonsense", 1), (b"frames", 0)):
            socket.send_fds(sender, [said], [nothing.fileno()] * count)
        assert control.poll() == ["screen on"]
    assert len(os.listdir("/proc/self/fd")) == before


def test_no_daemon(tmp_path: Path) -> None:
    """Without a daemon there is nothing to ask; what a dead one left behind is none."""
    assert open_daemon(tmp_path / "none") is None
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as dead:
        dead.bind(str(tmp_path / "dead"))
    assert open_daemon(tmp_path / "dead") is None


def test_older_daemon(control: Control, monkeypatch: pytest.MonkeyPatch) -> None:
    """A daemon that does not know the command answers nothing: the error says what to do."""
    monkeypatch.setattr("touchd.service.frame_feed._ANSWER_S", 0.05)
    with pytest.raises(BusError, match="as the daemon's own user"):
        open_daemon(control.path)
