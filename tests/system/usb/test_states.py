"""The source reports all that happens to the device, and looks for it again; its thread never fails in silence."""

from __future__ import annotations

import errno
import threading

import pytest

from tests.processes import PATIENCE_S
from tests.system.usb.backend import FakeBus, FakeDaq, steady
from tests.system.usb.reader import Read, wait
from touchd.errors import ReaderFailed
from touchd.sources.daq import Waits
from touchd.sources.source import EndOfStream
from touchd.sources.usb_protocol import Request

GONE = (errno.EIO, errno.ENODEV, errno.EPROTO, errno.ESHUTDOWN)


@pytest.mark.parametrize("number", GONE)
def test_pulled_cable(daq: FakeDaq, read: Read, number: int) -> None:
    """After each error that a pulled cable shows, the device is opened again and numbers go on."""
    steady(daq)
    reader = read()
    reader.until_frames(5)
    daq.send(number)
    reader.until_frames(10)
    assert reader.states == ["streaming", "lost", "streaming"]
    assert errno.errorcode[number] in reader.changes[1].reason
    assert reader.sequence == list(range(10)), "numbers go on"
    assert reader.source.tally.lost == 0
    assert daq.closed == daq.opened - 1


@pytest.mark.parametrize("first_error", [errno.ENODEV, errno.EIO])
def test_replugged(daq: FakeDaq, read: Read, first_error: int) -> None:
    """An unplugged device is closed, and found again under another address."""
    daq.lost_on_unplug = first_error
    steady(daq)
    reader = read()
    reader.until_frames(5)
    daq.unplug()
    reader.until_state("lost")
    reader.until(lambda: "1209:0001" in reader.changes[-1].reason)
    assert daq.opened == daq.closed, "nothing is held on to"
    daq.plug()
    reader.until_frames(10)
    assert reader.states == ["streaming", "lost", "streaming"]


def test_plugged_in_later(daq: FakeDaq, read: Read) -> None:
    """A source without a device is lost, until the device comes."""
    daq.unplug()
    steady(daq)
    reader = read()
    reader.until_state("lost")
    daq.plug()
    reader.until_frames(5)
    assert reader.states == ["lost", "streaming"]


def test_frames_before_a_loss(daq: FakeDaq, read: Read) -> None:
    """Frames that came before a loss are read before its change of state."""
    daq.started = lambda: daq.send(*[daq.frame() for _ in range(10)], errno.ENODEV)
    reader = read()
    reader.until_state("lost")
    assert len(reader.frames) == 10


def test_no_frame_overtakes_a_change(daq: FakeDaq, read: Read) -> None:
    """Until the change is taken, `read` returns None."""
    steady(daq)
    source = read().source
    wait(lambda: daq.running and daq.idle)
    assert [source.read(0.01) for _ in range(5)] == [None] * 5
    assert [change.state for change in source.changes()] == ["streaming"]
    assert source.read(1.0) is not None


def test_silence(daq: FakeDaq, read: Read) -> None:
    """A silent device is restarted, with its halt cleared; if it stays silent it is reset."""
    steady(daq)
    reader = read(stall_s=0.05)
    reader.until_frames(5)
    daq.started = lambda: None
    reader.until_state("stalled")
    reader.until(lambda: daq.resets)
    assert daq.cleared >= 1
    assert [request for request, _ in daq.requests].count(Request.START) >= 2
    steady(daq)
    reader.until_state("streaming", 2)
    assert reader.states[:3] == ["streaming", "stalled", "lost"]
    assert reader.changes[1].reason == "no frame for 0.05 s"


def test_restart(daq: FakeDaq, read: Read) -> None:
    """A restart that helps is followed by no reset, and its first frame may have any number."""

    def send() -> None:
        daq.sequence += 1000
        daq.send(*[daq.frame() for _ in range(5)])

    daq.started = send
    reader = read(stall_s=0.05)
    reader.until_frames(10)  # the second five are those of a restarted stream
    assert reader.sequence[:10] == list(range(1000, 1010))
    assert reader.source.tally.lost == 0
    assert reader.states[:3] == ["streaming", "stalled", "streaming"]
    assert daq.resets == 0


def test_rubbish_stalls(daq: FakeDaq, read: Read) -> None:
    """A device that sends only rubbish has stalled."""

    def send_rubbish() -> bytes:
        threading.Event().wait(0.001)
        return b"rubbish"

    daq.source = send_rubbish
    reader = read(stall_s=0.05)
    reader.until_state("stalled")
    assert reader.frames == []
    assert reader.source.tally.corrupt > 1


def test_lasting_halt(daq: FakeDaq, read: Read) -> None:
    """A device whose endpoint stays halted is reset."""
    daq.source = lambda: errno.EPIPE
    reader = read(stall_s=0.05)
    reader.until(lambda: daq.resets)
    assert daq.cleared > 1
    daq.source = lambda: None
    steady(daq)
    reader.until_frames(5)


@pytest.mark.parametrize(
    ("request_", "number", "what"),
    [(Request.START, errno.EPIPE, "START"), (Request.GET_INFO, errno.ETIMEDOUT, "does not answer GET_INFO")],
)
def test_request_fails(daq: FakeDaq, read: Read, request_: Request, number: int, what: str) -> None:
    """A device that refuses START, or does not answer GET_INFO, is lost, and tried again."""
    daq.control_errors[request_] = number
    steady(daq)
    reader = read()
    reader.until_state("lost")
    assert what in reader.changes[-1].reason
    daq.control_errors.clear()
    reader.until_frames(5)


@pytest.mark.parametrize(
    ("attribute", "number", "what"),
    [
        ("open_error", errno.EACCES, "no permission"),
        ("claim_error", errno.EBUSY, "another program"),
        ("claim_error", errno.ENOENT, "cannot be opened"),
    ],
)
def test_not_opened(daq: FakeDaq, read: Read, attribute: str, number: int, what: str) -> None:
    """A device that cannot be opened is lost, with the reason, and tried again."""
    setattr(daq, attribute, number)
    steady(daq)
    reader = read()
    reader.until_state("lost")
    assert what in reader.changes[-1].reason
    setattr(daq, attribute, 0)
    reader.until_frames(5)
    assert reader.states == ["lost", "streaming"]


def test_driver_and_configuration(daq: FakeDaq, read: Read) -> None:
    """A kernel driver is detached, and a configuration that is not set is set."""
    daq.kernel_driver = True
    daq.configuration = 0
    steady(daq)
    read().until_frames(5)
    assert (daq.kernel_driver, daq.configuration) == (False, 1)


def test_bus_not_listed(bus: FakeBus, daq: FakeDaq, read: Read) -> None:
    """A bus that cannot be listed is tried again."""
    bus.list_error = errno.EIO
    steady(daq)
    reader = read()
    reader.until_state("lost")
    bus.list_error = 0
    reader.until_frames(5)


def test_dead_thread(daq: FakeDaq, read: Read) -> None:
    """The error of a thread that dies comes out of `read`."""

    def die() -> None:
        raise ZeroDivisionError("as never expected")

    daq.started = die
    error = read().error()
    assert isinstance(error, ReaderFailed)
    assert "as never expected" in str(error)
    assert isinstance(error.__cause__, ZeroDivisionError)


def test_hanging_thread(daq: FakeDaq, read: Read) -> None:
    """`read` raises an error once the thread hangs."""
    hang = threading.Event()

    def block() -> None:
        hang.wait(PATIENCE_S)

    daq.started = block
    error = read(waits=Waits(hang_s=0.2)).error()
    hang.set()
    assert isinstance(error, ReaderFailed)
    assert "hung" in str(error)


def test_close_while_hanging(daq: FakeDaq, read: Read) -> None:
    """`close` does not wait for a thread that hangs."""
    hang, hung = threading.Event(), threading.Event()

    def block() -> None:
        hung.set()
        hang.wait(PATIENCE_S)

    daq.started = block
    source = read().source
    assert hung.wait(PATIENCE_S)
    source.close()
    assert not hang.is_set(), "closed while the thread was still held"
    hang.set()


def test_close(daq: FakeDaq, read: Read) -> None:
    """After `close` the stream has ended and the device is released."""
    steady(daq)
    reader = read()
    reader.until_frames(1)
    reader.source.close()
    with pytest.raises(EndOfStream):
        reader.source.read(0.1)
    assert not daq.running
    assert daq.opened == daq.closed
