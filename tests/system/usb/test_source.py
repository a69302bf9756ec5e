"""Whatever the device does: each frame once, each loss counted, each state told, and never silence."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from tests.processes import PATIENCE_S
from tests.system.usb.backend import FakeBus, FakeDaq
from tests.system.usb.reader import INFO, QUICK, Reader
from touchd.config.schema import DeviceSettings
from touchd.errors import ConfigError, DeviceLost, ModelMismatch, ReaderFailed, SourceError
from touchd.frame import Acquisition, Chirp
from touchd.localization.model import Model
from touchd.sources.live import Waits
from touchd.sources.source import EndOfStream, LiveSource
from touchd.sources.usb import libusb, open_usb
from touchd.sources.usb_protocol import Flag, Info, Request, build_info
from touchd.sources.usb_stream import acquisition_of

Read = Callable[..., Reader]
GONE = (errno.EIO, errno.ENODEV, errno.EPROTO, errno.ESHUTDOWN)


def samples(seed: int) -> bytes:
    return np.random.default_rng(seed).integers(-32768, 32768, 1000).astype("<i2").tobytes()


def steady(daq: FakeDaq, count: int = 5) -> None:
    """Have the device send so many frames whenever it is started."""
    daq.started = lambda: daq.send(*[daq.frame() for _ in range(count)])


def without_crc(frame: bytes) -> bytes:
    return frame[:28] + bytes(4) + frame[32:]


# -- frames ------------------------------------------------------------------------------------------


def test_frames_arrive_as_they_were_sent(daq: FakeDaq, read: Read) -> None:
    sent = [samples(seed) for seed in range(5)]
    daq.started = lambda: daq.send(*[daq.frame(data) for data in sent])
    reader = read()
    assert isinstance(reader.source, LiveSource)
    reader.until_frames(5)
    for frame, data in zip(reader.frames, sent, strict=True):
        interleaved = np.frombuffer(data, "<i2").reshape(250, 4)
        np.testing.assert_array_equal(frame.counts, interleaved.T)
        assert frame.counts.dtype == np.int16
    assert reader.sequence == [0, 1, 2, 3, 4]
    assert reader.states == ["streaming"]
    assert daq.requests[-1] == (Request.START, 125)


def test_the_rate_that_is_set_is_asked_for(daq: FakeDaq, read: Read) -> None:
    steady(daq)
    read(rate_hz=500).until_frames(1)
    assert (Request.START, 500) in daq.requests


def test_what_a_stream_before_left_behind_is_thrown_away(daq: FakeDaq, read: Read) -> None:
    daq.send(*[daq.frame(sequence=7) for _ in range(3)])
    steady(daq)
    reader = read()
    reader.until_frames(5)
    assert reader.sequence == [8, 9, 10, 11, 12]


def test_times_are_the_devices_and_never_after_the_frame_was_complete(daq: FakeDaq, read: Read) -> None:
    steady(daq, 50)
    reader = read()
    reader.until_frames(50)
    t_ns = np.array([frame.t_ns for frame in reader.frames])
    received_ns = np.array([frame.received_ns for frame in reader.frames])
    assert (np.diff(t_ns) > 0).all()
    # All came at once, though they were sampled 8 ms apart: by arrival they would lie within a millisecond or so.
    assert np.diff(t_ns).min() > 7e6
    assert t_ns[0] == received_ns[0] - 1_000_000


def test_the_counter_goes_on_over_its_wrap(daq: FakeDaq, read: Read) -> None:
    daq.sequence = 2**32 - 3
    daq.started = lambda: daq.send(*[daq.frame(sequence=(2**32 - 3 + i) % 2**32, timestamp_us=i) for i in range(6)])
    reader = read()
    reader.until_frames(6)
    assert reader.sequence == [2**32 - 3 + i for i in range(6)]
    assert reader.source.tally.lost == 0


def test_each_loss_is_counted_once_and_under_its_name(daq: FakeDaq, read: Read) -> None:
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
def test_a_frame_that_shows_no_plate_is_withheld_and_counted(daq: FakeDaq, read: Read, flag: Flag) -> None:
    daq.started = lambda: daq.send(daq.frame(), daq.frame(flags=flag), daq.frame())
    reader = read()
    reader.until_frames(2)
    assert reader.sequence == [0, 2]
    assert reader.source.tally.withheld == {flag.name.lower(): 1} if flag.name else None
    assert reader.source.tally.lost == 0


def test_clipped_frames_are_counted_and_passed_on(daq: FakeDaq, read: Read) -> None:
    daq.started = lambda: daq.send(daq.frame(), daq.frame(flags=Flag.CLIPPED), daq.frame())
    reader = read()
    reader.until_frames(3)
    assert reader.source.tally.clipped == 1


def test_a_late_frame_is_counted(daq: FakeDaq, read: Read) -> None:
    # By the device's clock the last one is from a second before it comes; all before come as soon as they are made.
    daq.started = lambda: daq.send(*[daq.frame(timestamp_us=i) for i in range(1, 4)])
    reader = read(rate_hz=1000)
    reader.until_frames(3)
    threading.Event().wait(0.05)
    daq.send(daq.frame(timestamp_us=10))
    reader.until_frames(4)
    assert reader.source.tally.late >= 1


def test_who_reads_too_slowly_loses_the_oldest_and_it_is_counted(daq: FakeDaq, read: Read) -> None:
    reader = read(queue_frames=4)
    steady(daq, 1)
    reader.until(lambda: daq.running)
    daq.send(*[daq.frame() for _ in range(100)])
    reader.until(lambda: reader.source.tally.behind or daq.idle)
    while not daq.idle:
        threading.Event().wait(0.001)
    threading.Event().wait(0.05)  # the last one is on its way through the thread
    reader.until(lambda: reader.step() is None)
    tally = reader.source.tally
    assert len(reader.frames) + tally.behind == daq.sequence
    assert tally.lost == 0, "dropped here is not lost there"
    assert reader.sequence[-1] == daq.sequence - 1, "the newest is kept"
    assert all(b > a for a, b in pairwise(reader.sequence))


# -- transfers ---------------------------------------------------------------------------------------


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
def test_whatever_comes_between_two_frames_both_are_read(
    daq: FakeDaq, read: Read, between: list[bytes | int], corrupt: int
) -> None:
    daq.started = lambda: daq.send(daq.frame(), *between, daq.frame())
    reader = read()
    reader.until_frames(2)
    assert reader.sequence == [0, 1]
    assert reader.source.tally.corrupt == corrupt
    assert reader.source.tally.lost == 0
    assert reader.states == ["streaming"], "none of these is a change of state"
    assert daq.cleared == between.count(errno.EPIPE)


def test_a_frame_in_pieces_is_put_together(daq: FakeDaq, read: Read) -> None:
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


def test_a_frame_that_fills_its_last_packet_needs_no_luck(bus: FakeBus, read: Read) -> None:
    info = Info(channels=4, samples=252, sample_rate_hz=250_000)
    assert info.frame_bytes % 512 == 0
    daq = FakeDaq(info)
    bus.daqs[:] = [daq]
    daq.started = lambda: daq.send(*[part for _ in range(5) for part in (daq.frame(), b"")])
    reader = read(acquisition_of(info))
    reader.until_frames(5)
    assert (reader.source.tally.corrupt, reader.source.tally.lost) == (0, 0)


# -- states ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", GONE)
def test_each_error_of_a_pulled_cable_means_look_again(daq: FakeDaq, read: Read, number: int) -> None:
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
def test_unplugged_and_plugged_in_again_it_goes_on(daq: FakeDaq, read: Read, first_error: int) -> None:
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


def test_a_device_that_comes_later_is_found(daq: FakeDaq, read: Read) -> None:
    daq.unplug()
    steady(daq)
    reader = read()
    reader.until_state("lost")
    daq.plug()
    reader.until_frames(5)
    assert reader.states == ["lost", "streaming"]


def test_frames_before_a_loss_are_read_before_it_is_told(daq: FakeDaq, read: Read) -> None:
    daq.started = lambda: daq.send(*[daq.frame() for _ in range(10)], errno.ENODEV)
    reader = read()
    reader.until_state("lost")
    assert len(reader.frames) == 10


def test_no_frame_overtakes_a_change_that_nobody_has_taken(daq: FakeDaq, read: Read) -> None:
    steady(daq)
    source = read().source
    while not daq.idle or not daq.running:
        threading.Event().wait(0.001)
    assert [source.read(0.01) for _ in range(5)] == [None] * 5
    assert [change.state for change in source.changes()] == ["streaming"]
    assert source.read(1.0) is not None


def test_a_silent_device_is_started_again_and_then_reset(daq: FakeDaq, read: Read) -> None:
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


def test_a_stream_that_can_be_restarted_is_not_reset_and_may_count_on_from_any_number(daq: FakeDaq, read: Read) -> None:
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


def test_a_device_that_sends_only_rubbish_has_stalled(daq: FakeDaq, read: Read) -> None:
    def send_rubbish() -> bytes:
        threading.Event().wait(0.001)
        return b"rubbish"

    daq.source = send_rubbish
    reader = read(stall_s=0.05)
    reader.until_state("stalled")
    assert reader.frames == []
    assert reader.source.tally.corrupt > 1


def test_an_endpoint_that_stays_halted_is_reset(daq: FakeDaq, read: Read) -> None:
    daq.source = lambda: errno.EPIPE
    reader = read(stall_s=0.05)
    reader.until(lambda: daq.resets)
    assert daq.cleared > 1
    daq.source = lambda: None
    steady(daq)
    reader.until_frames(5)


def test_a_device_that_refuses_to_start_is_tried_again(daq: FakeDaq, read: Read) -> None:
    daq.control_errors[Request.START] = errno.EPIPE
    steady(daq)
    reader = read()
    reader.until_state("lost")
    assert "START" in reader.changes[-1].reason
    daq.control_errors.clear()
    reader.until_frames(5)


def test_a_device_that_does_not_answer_is_tried_again(daq: FakeDaq, read: Read) -> None:
    daq.control_errors[Request.GET_INFO] = errno.ETIMEDOUT
    steady(daq)
    reader = read()
    reader.until_state("lost")
    assert "does not answer GET_INFO" in reader.changes[-1].reason
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
def test_a_device_that_may_not_be_opened_is_tried_again_and_says_why(
    daq: FakeDaq, read: Read, attribute: str, number: int, what: str
) -> None:
    setattr(daq, attribute, number)
    steady(daq)
    reader = read()
    reader.until_state("lost")
    assert what in reader.changes[-1].reason
    setattr(daq, attribute, 0)
    reader.until_frames(5)
    assert reader.states == ["lost", "streaming"]


def test_a_kernel_driver_is_detached_and_the_configuration_set_if_it_is_not(daq: FakeDaq, read: Read) -> None:
    daq.kernel_driver = True
    daq.configuration = 0
    steady(daq)
    read().until_frames(5)
    assert (daq.kernel_driver, daq.configuration) == (False, 1)


def test_a_bus_that_cannot_be_listed_is_tried_again(bus: FakeBus, daq: FakeDaq, read: Read) -> None:
    bus.list_error = errno.EIO
    steady(daq)
    reader = read()
    reader.until_state("lost")
    bus.list_error = 0
    reader.until_frames(5)


# -- which device ------------------------------------------------------------------------------------


def test_the_device_with_the_serial_number_is_taken(bus: FakeBus, daq: FakeDaq, read: Read) -> None:
    other = FakeDaq(INFO, serial="SN0002")
    bus.daqs.append(other)
    steady(other)
    reader = read(serial="SN0002")
    reader.until_frames(1)
    assert reader.source.device.serial == "SN0002"
    assert reader.source.device.firmware == "1.2.3"
    assert (daq.running, other.running) == (False, True)


def test_a_wrong_serial_number_is_named(read: Read) -> None:
    reader = read(serial="SN9")
    reader.until_state("lost")
    assert "'SN0001', not 'SN9'" in reader.changes[-1].reason


def test_a_foreign_device_with_the_same_ids_is_passed_over(bus: FakeBus, daq: FakeDaq, read: Read) -> None:
    foreign = FakeDaq(INFO)
    foreign.interface.bInterfaceSubClass = 0
    bus.daqs.insert(0, foreign)
    steady(daq)
    reader = read()
    reader.until_frames(1)
    assert (foreign.opened, foreign.requests) == (0, [])
    bus.daqs.remove(daq)
    daq.unplug()
    reader.until(lambda: "no interface of touchd's protocol" in reader.changes[-1].reason)


# -- what cannot go on -------------------------------------------------------------------------------


def error_of(reader: Reader) -> Exception:
    for _ in range(10_000):
        try:
            reader.step()
        except Exception as error:
            return error
    pytest.fail("nothing was raised")


def test_a_device_that_the_model_does_not_fit_is_refused(daq: FakeDaq, read: Read, model: Model) -> None:
    daq.answer = build_info(Info(channels=4, samples=250, sample_rate_hz=500_000))
    error = error_of(read(model.description.acquisition, model.check))
    assert isinstance(error, ModelMismatch)
    assert "sample_rate_hz" in str(error)
    assert daq.opened == daq.closed


def test_the_shipped_model_fits_the_reference_device(daq: FakeDaq, read: Read, model: Model) -> None:
    steady(daq)
    read(model.description.acquisition, model.check).until_frames(5)


@pytest.mark.parametrize("rate_hz", [9, 1001])
def test_a_rate_that_the_device_does_not_have_is_refused(read: Read, rate_hz: int) -> None:
    error = error_of(read(rate_hz=rate_hz))
    assert isinstance(error, ConfigError)
    assert "10 to 1000" in str(error)


@pytest.mark.parametrize("answer", [b"", bytes(64), build_info(INFO).replace(b"TDAQ\1", b"TDAQ\2")])
def test_another_protocol_is_refused(daq: FakeDaq, read: Read, answer: bytes) -> None:
    daq.answer = answer
    error = error_of(read())
    assert isinstance(error, SourceError)
    assert "firmware" in str(error)


def test_a_device_that_refuses_get_info_is_refused(daq: FakeDaq, read: Read) -> None:
    daq.control_errors[Request.GET_INFO] = errno.EPIPE
    assert "refuses GET_INFO" in str(error_of(read()))


def test_a_thread_that_dies_is_not_silent(daq: FakeDaq, read: Read) -> None:
    def die() -> None:
        raise ZeroDivisionError("as never expected")

    daq.started = die
    error = error_of(read())
    assert isinstance(error, ReaderFailed)
    assert "as never expected" in str(error)
    assert isinstance(error.__cause__, ZeroDivisionError)


def test_a_thread_that_hangs_is_not_silent(daq: FakeDaq, read: Read) -> None:
    hang = threading.Event()

    def block() -> None:
        hang.wait(PATIENCE_S)

    daq.started = block
    error = error_of(read(waits=Waits(hang_s=0.2)))
    hang.set()
    assert isinstance(error, ReaderFailed)
    assert "hung" in str(error)


def test_closing_does_not_wait_for_a_thread_that_hangs(daq: FakeDaq, read: Read) -> None:
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


def test_after_close_the_stream_has_ended_and_the_device_is_free(daq: FakeDaq, read: Read) -> None:
    steady(daq)
    reader = read()
    reader.until_frames(1)
    reader.source.close()
    with pytest.raises(EndOfStream):
        reader.source.read(0.1)
    assert not daq.running
    assert daq.opened == daq.closed


# -- without a model ---------------------------------------------------------------------------------


def test_without_a_model_the_device_decides(daq: FakeDaq, bus: FakeBus) -> None:
    steady(daq)
    source = open_usb(DeviceSettings(), backend=bus)
    reader = Reader(source)
    reader.until_frames(5)
    source.close()
    assert source.acquisition == Acquisition(
        channels=4, samples=250, sample_rate_hz=250e3, bits=16, full_scale_v=10.0, chirp=Chirp()
    )


def test_without_a_model_and_a_device_there_is_nothing_to_be_done(daq: FakeDaq, bus: FakeBus) -> None:
    daq.unplug()
    with pytest.raises(DeviceLost, match="plug it in"):
        open_usb(DeviceSettings(), backend=bus)


def test_without_a_model_another_device_later_is_refused(daq: FakeDaq, bus: FakeBus) -> None:
    steady(daq)
    source = open_usb(DeviceSettings(), backend=bus)
    reader = Reader(source)
    reader.until_frames(5)
    daq.unplug()
    bus.daqs[:] = [FakeDaq(Info(channels=2, samples=250, sample_rate_hz=250_000))]
    assert "another DAQ" in str(error_of(reader))
    source.close()


def test_libusb_is_at_hand() -> None:
    assert libusb() is libusb()
    assert hasattr(libusb(), "enumerate_devices")
