"""Find, open and command a DAQ on USB: the only module that imports pyusb. docs/usb-protocol.md is the protocol."""

from __future__ import annotations

import contextlib
import ctypes
import errno
from array import array
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any, NoReturn

import usb.backend.libusb1
import usb.core
import usb.util

from touchd.config.schema import DeviceSettings
from touchd.errors import SourceError
from touchd.frame import Acquisition
from touchd.sources.daq import WAITS, Daq, DaqAbsent, DaqBusy, DaqGone, DaqUnfit, Waits, check_rate, open_first
from touchd.sources.live import DaqSource
from touchd.sources.usb_protocol import INFO_BYTES, INTERFACE_CLASS, Info, ProtocolFault, Request, parse_info
from touchd.sources.usb_stream import EndpointHalted, RequestRefused, TransferOverflow, UsbDaq, acquisition_of

CONTROL_TIMEOUT_MS = 500
_VENDOR_IN, _VENDOR_OUT = 0xC0, 0x40  # recipient device
_SYSTEM_LIBUSB = "libusb-1.0.so.0"


class UsbDevice:
    """An open device of protocol 1 whose interface is claimed: what `UsbDaq` needs of it.

    It takes pyusb's device and interface, and the value of the interface's configuration. Raises DaqAbsent if the
    device cannot be opened, DaqUnfit if it does not speak protocol 1.
    """

    def __init__(self, device: Any, configuration: int, interface: Any) -> None:
        self._device = device
        self._interface = interface.bInterfaceNumber
        endpoint = next(ep for ep in interface if _is_bulk_in(ep))
        self._endpoint = endpoint.bEndpointAddress
        self.packet_bytes: int = endpoint.wMaxPacketSize
        self._where = _where(device)
        try:
            if not self.packet_bytes:
                raise DaqUnfit(f"{self._where}: its endpoint has packets of 0 bytes -> correct its descriptors")
            self._open(configuration)
            self.serial = serial_of(device)
            self.info = self._ask_info()
        except BaseException:
            self.close()
            raise

    def command(self, request: Request, value: int = 0) -> None:
        """Send a request without data."""
        self._control(_VENDOR_OUT, request, value)

    def fill(self, buffer: array[int], timeout_ms: int) -> int | None:
        """Read one transfer into the buffer and return its length in bytes; None if nothing came in time."""
        try:
            return int(self._device.read(self._endpoint, buffer, timeout_ms))
        except usb.core.USBTimeoutError:
            return None
        except usb.core.USBError as error:
            if error.errno == errno.EPIPE:
                raise EndpointHalted from error
            if error.errno == errno.EOVERFLOW:
                raise TransferOverflow from error
            raise _gone(error) from error

    def clear_halt(self) -> None:
        """Clear a halt of the endpoint."""
        try:
            self._device.clear_halt(self._endpoint)
        except usb.core.USBError as error:
            raise DaqGone(f"its endpoint stays halted ({_name(error)})") from error

    def reset(self) -> None:
        """Reset the device, which breaks the connection."""
        # A device that comes back as another one ends its reset with "not found".
        with contextlib.suppress(usb.core.USBError):
            self._device.reset()

    def close(self) -> None:
        """Release the device; never fails."""
        with contextlib.suppress(usb.core.USBError):
            usb.util.release_interface(self._device, self._interface)
        with contextlib.suppress(usb.core.USBError):
            usb.util.dispose_resources(self._device)

    def _open(self, configuration: int) -> None:
        device, number = self._device, self._interface
        try:
            active = _active_configuration(device)
            with contextlib.suppress(NotImplementedError):
                if device.is_kernel_driver_active(number):
                    device.detach_kernel_driver(number)
            # Setting it again would abort the frame in flight.
            if active != configuration:
                device.set_configuration(configuration)
            usb.util.claim_interface(device, number)
        except usb.core.USBError as error:
            if error.errno == errno.EBUSY:
                raise DaqBusy(f"another program uses it ({self._where})") from error
            raise DaqAbsent(f"it cannot be opened ({self._where}: {_name(error)})") from error

    def _ask_info(self) -> Info:
        try:
            info = parse_info(bytes(self._control(_VENDOR_IN, Request.GET_INFO, 0, INFO_BYTES)))
            acquisition_of(info)  # refuses what no rig has
        except (RequestRefused, ProtocolFault) as error:
            raise DaqUnfit(
                f"{self._where}: {error} -> give the DAQ firmware for protocol 1, or set another id in "
                "device.vendor_id and product_id"
            ) from error
        return info

    def _control(self, kind: int, request: Request, value: int, size: int = 0) -> Any:
        try:
            return self._device.ctrl_transfer(kind, request, value, 0, size, CONTROL_TIMEOUT_MS)
        except usb.core.USBTimeoutError as error:
            raise DaqGone(f"it does not answer {request.name}") from error
        except usb.core.USBError as error:
            if error.errno == errno.EPIPE:
                raise RequestRefused(f"refuses {request.name}") from error
            raise _gone(error) from error


def candidates(settings: DeviceSettings, backend: Any) -> Iterator[Callable[[], Daq]]:
    """Yield calls that open a device with the ids, one for each device; see `Candidates`."""
    found, ids = False, {"idVendor": settings.vendor_id, "idProduct": settings.product_id}
    try:
        for device in usb.core.find(find_all=True, backend=backend, **ids):
            found = True
            yield partial(_open_daq, device, settings)
    except usb.core.USBError as error:
        raise DaqAbsent(f"devices cannot be listed ({_name(error)})") from error
    if not found:
        yield partial(_refuse, f"no DAQ with the ids {_ids(settings)} is plugged in")


def _open_daq(device: Any, settings: DeviceSettings) -> Daq:
    found = _interface(device)
    if found is None:
        _refuse(f"{_where(device)} has the ids {_ids(settings)}, but no interface of touchd's protocol")
    elif settings.serial and (serial := serial_of(device)) != settings.serial:
        try:
            _active_configuration(device)  # without permission no serial number can be read
        finally:
            usb.util.dispose_resources(device)
        _refuse(f"{_where(device)} has the serial number {serial!r}, not {settings.serial!r}")
    return UsbDaq(UsbDevice(device, *found))


def _refuse(why: str) -> NoReturn:
    raise DaqAbsent(why)


def open_usb(
    settings: DeviceSettings,
    acquisition: Acquisition | None = None,
    check: Callable[[Acquisition], None] | None = None,
    *,
    backend: Any = None,
    waits: Waits = WAITS,
) -> DaqSource:
    """Return the source of a DAQ on USB, by libusb or another backend of pyusb's; SourceError without libusb.

    With the acquisition that frames must have, the device may be plugged in later, and `check` compares (see
    `DaqSource`). Without it the device must be plugged in, and decides: DeviceLost if there is none, DeviceBusy if
    another program uses it, and ConfigError if it does not have the frame rate.
    """
    found = partial(candidates, settings, backend or libusb())  # without libusb this fails now
    device = None
    if acquisition is None:
        daq = open_first(found)
        acquisition, device = daq.acquisition, daq.device
        daq.close()
        check_rate(daq, settings)
    return DaqSource(found, settings, acquisition, check, device, waits=waits)


@cache
def libusb() -> Any:
    """Return pyusb's backend on the system's libusb, or on that of libusb-package; SourceError without either."""

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


def _interface(device: Any) -> tuple[int, Any] | None:
    """Return the value of the configuration, and in it the interface of protocol 1; None if the device has none."""
    with contextlib.suppress(usb.core.USBError):  # unplugged meanwhile
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
    """Return the value of the configuration that is set, None if none is; raises DaqAbsent without permission."""
    try:
        return int(device.get_active_configuration().bConfigurationValue)
    except usb.core.USBError as error:
        if error.errno == errno.EACCES:
            raise DaqAbsent(f"no permission to open it ({_where(device)}): install touchd's udev rules") from error
        return None


def _ids(settings: DeviceSettings) -> str:
    return f"{settings.vendor_id:04x}:{settings.product_id:04x}"


def _where(device: Any) -> str:
    return f"bus {device.bus or 0:03d} address {device.address or 0:03d}"


def _gone(error: usb.core.USBError) -> DaqGone:
    # A pulled cable shows as EIO, ENODEV, EPROTO or ESHUTDOWN. After any other error, too, only a new connection helps.
    return DaqGone(f"it is gone ({_name(error)})")


def _name(error: usb.core.USBError) -> str:
    return errno.errorcode.get(error.errno or 0, str(error))
