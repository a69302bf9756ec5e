"""A DAQ on USB. The only module that imports pyusb; docs/usb-protocol.md is what the device speaks."""

from __future__ import annotations

import array
import contextlib
import ctypes
import errno
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, NoReturn

import structlog
import usb.backend.libusb1
import usb.core
import usb.util

from touchd.config.schema import DeviceSettings
from touchd.errors import SourceError
from touchd.frame import Acquisition
from touchd.sources.daq import DaqAbsent, DaqGone, DaqHalted, DaqOverflow
from touchd.sources.live import DaqSource, open_live
from touchd.sources.usb_protocol import (
    INFO_BYTES,
    INTERFACE_CLASS,
    STATUS_BYTES,
    Info,
    ProtocolFault,
    Request,
    Status,
    parse_info,
    parse_status,
)

CONTROL_TIMEOUT_MS = 500
_DRAIN_TIMEOUT_MS = 10
_DRAIN_READS = 32
_VENDOR_IN, _VENDOR_OUT = 0xC0, 0x40  # recipient device
_SYSTEM_LIBUSB = "libusb-1.0.so.0"

log = structlog.get_logger()


class UsbDaq:
    """An open DAQ whose interface is claimed.

    Parameters
    ----------
    device : usb.core.Device
    configuration : int
        The value of the one that the interface belongs to.
    interface : usb.core.Interface
        The one of protocol 1.

    Raises
    ------
    DaqAbsent
        The device cannot be opened.
    SourceError
        It does not speak protocol 1.
    """

    def __init__(self, device: Any, configuration: int, interface: Any) -> None:
        self._device = device
        self._interface = interface.bInterfaceNumber
        endpoint = next(ep for ep in interface if _is_bulk_in(ep))
        self._endpoint = endpoint.bEndpointAddress
        self.packet_bytes: int = endpoint.wMaxPacketSize
        self.where = _where(device)
        try:
            self._open(configuration)
            self.serial = serial_of(device)
            self.info = self._ask_info()
        except BaseException:
            self.close()
            raise
        # Whole packets, so that no device can overflow it, and room for a frame that fills its last packet: the empty
        # packet behind it then belongs to the same transfer.
        packets = self.info.frame_bytes // self.packet_bytes + 1
        self._buffer = array.array("B", bytes(packets * self.packet_bytes))
        self._view = memoryview(self._buffer)

    def _open(self, configuration: int) -> None:
        device, number = self._device, self._interface
        try:
            with contextlib.suppress(NotImplementedError):
                if device.is_kernel_driver_active(number):
                    device.detach_kernel_driver(number)
            # Setting it again would abort the frame in flight.
            if _active_configuration(device) != configuration:
                device.set_configuration(configuration)
            usb.util.claim_interface(device, number)
        except usb.core.USBError as error:
            if error.errno == errno.EACCES:
                raise DaqAbsent(f"no permission to open it ({self.where}): install the udev rules of touchd") from error
            if error.errno == errno.EBUSY:
                raise DaqAbsent(f"another program uses it ({self.where})") from error
            raise DaqAbsent(f"it cannot be opened ({self.where}: {_name(error)})") from error

    def _ask_info(self) -> Info:
        try:
            data = self._control(_VENDOR_IN, Request.GET_INFO, 0, INFO_BYTES)
            return parse_info(bytes(data))
        except DaqHalted as error:
            raise SourceError("refuses GET_INFO", f"device {self.where}", _WRONG_FIRMWARE) from error
        except ProtocolFault as error:
            raise SourceError(str(error), f"device {self.where}", _WRONG_FIRMWARE) from error

    def start(self, rate_hz: int) -> None:
        """Begin the stream anew; what an earlier one left behind is thrown away."""
        self.stop()
        with contextlib.suppress(DaqHalted, DaqOverflow):
            for _ in range(_DRAIN_READS):
                if self._read(_DRAIN_TIMEOUT_MS) is None:
                    break
        try:
            self._control(_VENDOR_OUT, Request.START, rate_hz)
        except DaqHalted as error:
            raise DaqGone("it refuses START") from error

    def stop(self) -> None:
        """End the stream."""
        with contextlib.suppress(DaqHalted):  # it may say that there is none
            self._control(_VENDOR_OUT, Request.STOP, 0)

    def status(self) -> Status:
        """Return what the device counts."""
        try:
            return parse_status(bytes(self._control(_VENDOR_IN, Request.GET_STATUS, 0, STATUS_BYTES)))
        except (DaqHalted, ProtocolFault) as error:
            raise SourceError(f"GET_STATUS fails: {error}", f"device {self.where}", _WRONG_FIRMWARE) from error

    def read(self, timeout_s: float) -> memoryview | None:
        """Return what one transfer brought, valid until the next call; None if nothing came in time."""
        return self._read(round(timeout_s * 1000))

    def _read(self, timeout_ms: int) -> memoryview | None:
        try:
            size: int = self._device.read(self._endpoint, self._buffer, timeout_ms)
        except usb.core.USBTimeoutError:
            return None
        except usb.core.USBError as error:
            _translate(error)
        return self._view[:size]

    def clear_halt(self) -> None:
        """Let a halted endpoint go on."""
        try:
            self._device.clear_halt(self._endpoint)
        except usb.core.USBError as error:
            raise DaqGone(f"its endpoint stays halted ({_name(error)})") from error

    def reset(self) -> None:
        """Reset the device; it has to be looked for again."""
        # Not found is how a device that comes back as another one ends its reset.
        with contextlib.suppress(usb.core.USBError):
            self._device.reset()

    def close(self) -> None:
        """Let go of the device; never fails."""
        with contextlib.suppress(usb.core.USBError):
            usb.util.release_interface(self._device, self._interface)
        with contextlib.suppress(usb.core.USBError):
            usb.util.dispose_resources(self._device)

    def _control(self, kind: int, request: Request, value: int, size: int = 0) -> Any:
        try:
            return self._device.ctrl_transfer(kind, request, value, 0, size, CONTROL_TIMEOUT_MS)
        except usb.core.USBTimeoutError as error:
            raise DaqGone(f"it does not answer {request.name}") from error
        except usb.core.USBError as error:
            _translate(error)


_WRONG_FIRMWARE = "give the DAQ firmware for protocol 1, or another id in device.vendor_id and product_id"


def _translate(error: usb.core.USBError) -> NoReturn:
    """Raise what an error of libusb means to the state machine."""
    if error.errno == errno.EPIPE:
        raise DaqHalted from error
    if error.errno == errno.EOVERFLOW:
        raise DaqOverflow from error
    # EIO, ENODEV, EPROTO and ESHUTDOWN are how a cable that is pulled looks, and whatever else there is: a new
    # connection is the only thing that may help.
    raise DaqGone(f"it is gone ({_name(error)})") from error


def find_daq(settings: DeviceSettings, backend: Any = None) -> UsbDaq:
    """Return the first DAQ with the ids, and the serial number if one is set.

    Parameters
    ----------
    settings : DeviceSettings
    backend : usb.backend.IBackend, optional
        Instead of libusb.

    Raises
    ------
    DaqAbsent
        There is none that can be used; the text says why.
    SourceError
        It does not speak protocol 1; or there is no libusb.
    """
    ids = f"{settings.vendor_id:04x}:{settings.product_id:04x}"
    others = []
    for device in _devices(settings, backend or libusb()):
        found = _interface(device)
        if found is None:
            others.append(f"{_where(device)} has the ids {ids}, but no interface of touchd's protocol")
        elif settings.serial and (serial := serial_of(device)) != settings.serial:
            usb.util.dispose_resources(device)
            others.append(f"{_where(device)} has the serial number {serial!r}, not {settings.serial!r}")
        else:
            return UsbDaq(device, *found)
    raise DaqAbsent("; ".join(others) or f"no DAQ with the ids {ids} is plugged in")


def open_usb(
    settings: DeviceSettings,
    acquisition: Acquisition | None = None,
    check: Callable[[Acquisition], None] = lambda _: None,
    backend: Any = None,
) -> DaqSource:
    """Return the source of a DAQ on USB.

    Parameters
    ----------
    settings : DeviceSettings
    acquisition : Acquisition, optional
        What the frames must look like, with `check` to compare it with what the device says; the device may then be
        plugged in at any later time. Without it the device must be there, and decides.
    check : callable
        See `DaqSource`.
    backend : usb.backend.IBackend, optional
        Instead of libusb.

    Raises
    ------
    DeviceLost
        No device is there to say what its frames look like.
    SourceError
        There is no libusb, or the device does not speak protocol 1.
    """
    backend = backend or libusb()  # missing, it is a failure now and not one of the thread

    def find() -> UsbDaq:
        return find_daq(settings, backend)

    return open_live(find, settings) if acquisition is None else DaqSource(find, settings, acquisition, check)


@cache
def libusb() -> Any:
    """Return pyusb's backend on the system's libusb, or else on the one that comes with libusb-package.

    Raises
    ------
    SourceError
        There is neither.
    """

    def find(name: str) -> str | None:
        if "usb-1.0" not in name:
            return None
        with contextlib.suppress(OSError):
            ctypes.CDLL(_SYSTEM_LIBUSB)
            return _SYSTEM_LIBUSB
        with contextlib.suppress(ImportError):
            import libusb_package

            return libusb_package.find_library(name)
        return None

    backend = usb.backend.libusb1.get_backend(find_library=find)
    if backend is None:
        raise SourceError(
            "libusb is not installed", "device", "apt install libusb-1.0-0, or pip install libusb-package"
        )
    return backend


def serial_of(device: Any) -> str:
    """Return a device's serial number, empty if it has none or may not be opened."""
    try:
        return device.serial_number or ""
    except (usb.core.USBError, ValueError, NotImplementedError):
        return ""


def _devices(settings: DeviceSettings, backend: Any) -> Iterator[Any]:
    found: Iterator[Any] = usb.core.find(
        find_all=True, idVendor=settings.vendor_id, idProduct=settings.product_id, backend=backend
    )
    try:
        yield from found
    except usb.core.USBError as error:
        raise DaqAbsent(f"devices cannot be listed ({_name(error)})") from error


def _interface(device: Any) -> tuple[int, Any] | None:
    """Return the interface of protocol 1, behind the value of its configuration; or None."""
    with contextlib.suppress(usb.core.USBError):  # unplugged while it was looked at
        for configuration in device:
            for interface in configuration:
                kind = (interface.bInterfaceClass, interface.bInterfaceSubClass, interface.bInterfaceProtocol)
                if kind == INTERFACE_CLASS and any(_is_bulk_in(ep) for ep in interface):
                    return configuration.bConfigurationValue, interface
    return None


def _is_bulk_in(endpoint: Any) -> bool:
    direction, kind = endpoint.bEndpointAddress & 0x80, endpoint.bmAttributes & 0x03
    return (direction, kind) == (usb.util.ENDPOINT_IN, usb.util.ENDPOINT_TYPE_BULK)


def _active_configuration(device: Any) -> int | None:
    try:
        return int(device.get_active_configuration().bConfigurationValue)
    except usb.core.USBError as error:
        if error.errno in (errno.EACCES, errno.ENODEV):
            raise
        return None


def _where(device: Any) -> str:
    return f"bus {device.bus or 0:03d} address {device.address or 0:03d}"


def _name(error: usb.core.USBError) -> str:
    return errno.errorcode.get(error.errno or 0, str(error))
