"""Which device is opened, and which is refused."""

from __future__ import annotations

import errno

import pytest

from tests.system.usb.backend import FakeBus, FakeDaq, steady
from tests.system.usb.reader import INFO, Read, Reader
from touchd.config.schema import DeviceSettings
from touchd.errors import ConfigError, DeviceLost, ModelMismatch, SourceError
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


def test_model_mismatch(daq: FakeDaq, read: Read, model: Model) -> None:
    """A device that the model does not fit is refused and closed."""
    daq.answer = build_info(Info(channels=4, samples=250, sample_rate_hz=500_000))
    error = read(model.description.acquisition, model.check).error()
    assert isinstance(error, ModelMismatch)
    assert "sample_rate_hz" in str(error)
    assert daq.opened == daq.closed


def test_shipped_model(daq: FakeDaq, read: Read, model: Model) -> None:
    """The shipped model fits the reference device."""
    steady(daq)
    read(model.description.acquisition, model.check).until_frames(5)


@pytest.mark.parametrize("rate_hz", [9, 1001])
def test_impossible_rate(read: Read, rate_hz: int) -> None:
    """A rate outside the device's range is refused, with the range."""
    error = read(rate_hz=rate_hz).error()
    assert isinstance(error, ConfigError)
    assert "10 to 1000" in str(error)


@pytest.mark.parametrize("answer", [b"", bytes(64), build_info(INFO).replace(b"TDAQ\1", b"TDAQ\2")])
def test_other_protocol(daq: FakeDaq, read: Read, answer: bytes) -> None:
    """A device of another protocol is refused."""
    daq.answer = answer
    error = read().error()
    assert isinstance(error, SourceError)
    assert "firmware" in str(error)


def test_get_info_refused(daq: FakeDaq, read: Read) -> None:
    """A device that refuses GET_INFO is refused."""
    daq.control_errors[Request.GET_INFO] = errno.EPIPE
    assert "refuses GET_INFO" in str(read().error())


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


def test_no_model_other_device(daq: FakeDaq, bus: FakeBus) -> None:
    """Without a model a later device with other frames is refused."""
    steady(daq)
    source = open_usb(DeviceSettings(), backend=bus)
    reader = Reader(source)
    reader.until_frames(5)
    daq.unplug()
    bus.daqs[:] = [FakeDaq(Info(channels=2, samples=250, sample_rate_hz=250_000))]
    assert "another DAQ" in str(reader.error())
    source.close()


def test_libusb() -> None:
    """libusb is found, and loaded once."""
    assert libusb() is libusb()
    assert hasattr(libusb(), "enumerate_devices")
