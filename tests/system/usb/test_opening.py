"""Which device is opened, and which is refused."""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import replace

import pytest
from structlog.testing import capture_logs

from tests.system.usb.backend import FakeBus, FakeDaq, steady
from tests.system.usb.reader import INFO, Read, Reader
from touchd.config.schema import DeviceSettings
from touchd.errors import ConfigError, DeviceBusy, DeviceLost
from touchd.frame import Acquisition, Chirp
from touchd.localization.model import Model
from touchd.sources.usb import libusb, open_usb
from touchd.sources.usb_protocol import Info, Request, build_info


def test_serial_number(bus: FakeBus, daq: FakeDaq, read: Read) -> None:
    """Of several devices that with `device.serial` is opened."""
    other = FakeDaq(INFO, serial="SN0002")
    bus.daqs.append(other)
    steady(other)
    reader = read(serial="SN0002")
    reader.until_frames(1)
    assert reader.source.device.serial == "SN0002"
    assert reader.source.device.firmware == "1.2.3"
    assert (daq.running, other.running) == (False, True)


def test_wrong_serial_number(read: Read) -> None:
    """The reason names the serial number that was found, and that which was asked for."""
    reader = read(serial="SN9")
    reader.until_state("lost")
    assert "'SN0001', not 'SN9'" in reader.changes[-1].reason


def test_serial_number_not_permitted(daq: FakeDaq, read: Read) -> None:
    """Without permission no serial number can be read: the reason names the permission."""
    daq.open_error = errno.EACCES
    reader = read(serial="SN0001")
    reader.until_state("lost")
    assert "no permission" in reader.changes[-1].reason


def test_foreign_device(bus: FakeBus, daq: FakeDaq, read: Read) -> None:
    """A device with the same ids but without the interface is not opened, and named as the reason."""
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


def test_model_mismatch(daq: FakeDaq, bus: FakeBus, read: Read, model: Model) -> None:
    """A device that the model does not fit is skipped and closed, with the reason; one that fits is found later."""
    daq.answer = build_info(Info(channels=4, samples=250, sample_rate_hz=500_000))
    reader = read(model.description.acquisition, model.check)
    reader.until_state("lost")
    assert "sample_rate_hz" in reader.changes[-1].reason
    fits = FakeDaq(INFO)
    steady(fits)
    bus.daqs.append(fits)
    reader.until_frames(5)
    assert reader.states == ["lost", "streaming"]
    assert daq.opened == daq.closed


UNFIT: list[Callable[[FakeDaq], object]] = [
    lambda daq: setattr(daq, "answer", b""),
    lambda daq: setattr(daq, "answer", build_info(INFO).replace(b"TDAQ\1", b"TDAQ\2")),
    lambda daq: setattr(daq, "answer", build_info(Info(channels=2, samples=250, sample_rate_hz=250_000))),
    lambda daq: setattr(daq, "answer", build_info(replace(INFO, max_frame_rate_hz=100))),
    lambda daq: setattr(daq, "answer", build_info(replace(INFO, chirp_us=2**32 - 1))),
    lambda daq: daq.control_errors.update({Request.GET_INFO: errno.EPIPE}),
    lambda daq: daq.control_errors.update({Request.GET_INFO: errno.EIO}),
    lambda daq: daq.control_errors.update({Request.START: errno.EPIPE}),
    lambda daq: setattr(daq, "open_error", errno.EACCES),
    lambda daq: setattr(daq, "claim_error", errno.EBUSY),
    lambda daq: setattr(daq.endpoint, "wMaxPacketSize", 0),
]


@pytest.mark.parametrize("spoil", UNFIT)
def test_unfit_neighbour(
    daq: FakeDaq, bus: FakeBus, read: Read, model: Model, spoil: Callable[[FakeDaq], object]
) -> None:
    """A device that cannot be used does not keep another one from being used."""
    steady(daq)
    unfit = FakeDaq(INFO, "UNFIT")
    spoil(unfit)
    bus.daqs.insert(0, unfit)
    read(model.description.acquisition, model.check).until_frames(5)


def test_silent_neighbour(daq: FakeDaq, bus: FakeBus, read: Read, model: Model) -> None:
    """A device that never sends a frame gives way to another one."""
    steady(daq)
    bus.daqs.insert(0, FakeDaq(INFO, "SILENT"))
    read(model.description.acquisition, model.check, stall_s=0.05).until_frames(5)


def test_skipped_is_named(daq: FakeDaq, bus: FakeBus, read: Read, model: Model) -> None:
    """While frames arrive, the reason names a device that was skipped, and the log has it once."""
    steady(daq)
    bus.daqs.insert(0, unfit := FakeDaq(INFO, "UNFIT"))
    unfit.answer = build_info(replace(INFO, sample_rate_hz=500_000))
    with capture_logs() as lines:
        reader = read(model.description.acquisition, model.check)
        reader.until_frames(5)
        daq.send(errno.EIO)
        reader.until_frames(10)
    assert reader.changes[-1].state == "streaming"
    assert "'UNFIT' is skipped" in reader.changes[-1].reason
    assert [line["event"] for line in lines].count("device skipped") == 1


def test_shipped_model(daq: FakeDaq, read: Read, model: Model) -> None:
    """The shipped model fits the reference device."""
    steady(daq)
    read(model.description.acquisition, model.check).until_frames(5)


@pytest.mark.parametrize("rate_hz", [9, 1001])
def test_impossible_rate(read: Read, bus: FakeBus, rate_hz: int) -> None:
    """A device without the rate is skipped, and the reason has its range; without a model this is an error."""
    reader = read(rate_hz=rate_hz)
    reader.until_state("lost")
    assert "10 to 1000" in reader.changes[-1].reason
    with pytest.raises(ConfigError, match="10 to 1000"):
        open_usb(DeviceSettings(rate_hz=rate_hz), backend=bus)


@pytest.mark.parametrize("answer", [b"", bytes(64), build_info(INFO).replace(b"TDAQ\1", b"TDAQ\2")])
def test_other_protocol(daq: FakeDaq, read: Read, answer: bytes) -> None:
    """A device of another protocol is skipped."""
    daq.answer = answer
    reader = read()
    reader.until_state("lost")
    assert "firmware" in reader.changes[-1].reason
    assert daq.opened == daq.closed


def test_get_info_refused(daq: FakeDaq, read: Read) -> None:
    """A device that refuses GET_INFO is skipped."""
    daq.control_errors[Request.GET_INFO] = errno.EPIPE
    reader = read()
    reader.until_state("lost")
    assert "refuses GET_INFO" in reader.changes[-1].reason


def test_no_model(daq: FakeDaq, bus: FakeBus) -> None:
    """Without a model the device decides what its frames look like."""
    steady(daq)
    source = open_usb(DeviceSettings(), backend=bus)
    reader = Reader(source)
    reader.until_frames(5)
    source.close()
    assert source.acquisition == Acquisition(
        channels=4, samples=250, sample_rate_hz=250e3, bits=16, full_scale_v=10.0, chirp=Chirp()
    )


def test_no_model_no_device(daq: FakeDaq, bus: FakeBus) -> None:
    """Without a model a device must be plugged in."""
    daq.unplug()
    with pytest.raises(DeviceLost, match="plug it in"):
        open_usb(DeviceSettings(), backend=bus)


def test_no_model_busy(daq: FakeDaq, bus: FakeBus) -> None:
    """Without a model a device that another program uses is not to be plugged in: its daemon can hand out frames."""
    bus.daqs.append(FakeDaq(INFO, serial="SN0002"))
    bus.daqs[1].open_error = errno.EACCES
    daq.claim_error = errno.EBUSY
    with pytest.raises(DeviceBusy, match=r"another program uses it .+ -> stop the daemon, or set control\.socket"):
        open_usb(DeviceSettings(), backend=bus)


def test_no_model_other_device(daq: FakeDaq, bus: FakeBus) -> None:
    """Without a model a later device with other frames is skipped."""
    steady(daq)
    source = open_usb(DeviceSettings(), backend=bus)
    reader = Reader(source)
    reader.until_frames(5)
    daq.unplug()
    bus.daqs[:] = [FakeDaq(Info(channels=2, samples=250, sample_rate_hz=250_000))]
    reader.until(lambda: "another DAQ" in reader.changes[-1].reason)
    source.close()


def test_libusb() -> None:
    """libusb is found, and loaded once."""
    assert libusb() is libusb()
    assert hasattr(libusb(), "enumerate_devices")
