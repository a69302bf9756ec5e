"""A USB bus in memory: a pyusb backend, and DAQs on it that speak the protocol and fail on demand."""

from __future__ import annotations

import array
import errno
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import usb.backend
from usb.core import USBError, USBTimeoutError

from touchd.sources.usb_protocol import Header, Info, Request, Status, build_frame, build_info, build_status

ENDPOINT = 0x81
PACKET_BYTES = 512
Transfer = bytes | int
"""What one read meets: the bytes of a transfer, or an errno that it fails with once."""

# How libusb 1.0 numbers its errors.
_LIBUSB = {
    errno.EIO: -1, errno.EACCES: -3, errno.ENODEV: -4, errno.ENOENT: -5, errno.EBUSY: -6, errno.ETIMEDOUT: -7,
    errno.EOVERFLOW: -8, errno.EPIPE: -9, errno.EINTR: -10,
}  # fmt: skip


def usb_error(number: int) -> USBError:
    """The exception that pyusb makes of an error of libusb."""
    kind = USBTimeoutError if number == errno.ETIMEDOUT else USBError
    return kind(errno.errorcode[number], _LIBUSB.get(number, -99), number)


class FakeDaq:
    """A device of the protocol. It sends what is queued, then what `source` returns, then nothing."""

    def __init__(
        self, info: Info, serial: str = "SN0001", *, vendor_id: int = 0x1209, product_id: int = 0x0001
    ) -> None:
        self.info = info
        self.present = True
        self.configuration = 1
        self.kernel_driver = False
        self.open_error = 0
        self.claim_error = 0
        self.control_errors: dict[Request, int] = {}
        self.requests: list[tuple[Request, int]] = []
        self.cleared = self.resets = self.opened = self.closed = 0
        self.running = False
        self.rate_hz = 0
        self.sequence = 0
        self.answer = build_info(info)
        self.source: Callable[[], Transfer | None] = lambda: None
        self.started: Callable[[], None] = lambda: None
        """Called when the host says START."""
        self.lost_on_unplug = errno.ENODEV
        """What a read meets that waits while the cable is pulled: EIO with the real kernel."""
        self.halted = False
        self.generation = 0
        self._queue: deque[Transfer] = deque()
        self._rest = b""
        self._ends_short = True
        self._changed = threading.Condition()
        interface_class = (0xFF, 0x54, 0x01)
        self.device = SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0xFF, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=vendor_id, idProduct=product_id, bcdDevice=0x100, iManufacturer=1, iProduct=2,
            iSerialNumber=3, bNumConfigurations=1, bus=1, address=2, port_number=1, port_numbers=(1,), speed=3,
        )  # fmt: skip
        self.strings = {1: "touchd", 2: "DAQ in memory", 3: serial}
        self.config = SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=25, bNumInterfaces=1, bConfigurationValue=1, iConfiguration=0,
            bmAttributes=0x80, bMaxPower=50, extra_descriptors=b"",
        )  # fmt: skip
        self.interface = SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=1,
            bInterfaceClass=interface_class[0], bInterfaceSubClass=interface_class[1],
            bInterfaceProtocol=interface_class[2], iInterface=0, extra_descriptors=b"",
        )  # fmt: skip
        self.endpoint = SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=ENDPOINT, bmAttributes=2, wMaxPacketSize=PACKET_BYTES,
            bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=b"",
        )  # fmt: skip

    # -- what a test does to it --------------------------------------------------------------------

    def frame(self, samples: bytes | None = None, **fields: Any) -> bytes:
        """The next frame; `fields` are those of its header."""
        period_us = 1_000_000 // (self.rate_hz or 125)
        header = Header(**({"sequence": self.sequence, "timestamp_us": self.sequence * period_us} | fields))
        self.sequence = header.sequence + 1
        size = 2 * self.info.channels * self.info.samples
        return build_frame(self.info, header, bytes(size) if samples is None else samples)

    def send(self, *transfers: Transfer) -> None:
        """Queue transfers and errors for the reads to come."""
        with self._changed:
            self._queue.extend(transfers)
            self._changed.notify_all()

    def unplug(self) -> None:
        """Pull the cable."""
        with self._changed:
            self.present = self.running = False
            self.generation += 1
            self._queue.clear()
            self._rest = b""
            self._changed.notify_all()

    def plug(self) -> None:
        """Plug it in again: the host gives it another address."""
        with self._changed:
            self.device = SimpleNamespace(**{**vars(self.device), "address": self.device.address % 126 + 1})
            self.present, self.halted = True, False

    @property
    def idle(self) -> bool:
        """Whether everything that was queued has been fetched."""
        with self._changed:
            return not self._queue and not self._rest

    # -- what the backend asks of it -----------------------------------------------------------------

    def control(self, kind: int, request: int, value: int, size: int) -> bytes:
        """Answer a vendor request."""
        if kind not in (0xC0, 0x40) or request not in list(Request):
            raise usb_error(errno.EPIPE)
        self.requests.append((Request(request), value))
        if number := self.control_errors.get(Request(request)):
            raise usb_error(number)
        if request == Request.GET_INFO:
            return self.answer[:size]
        if request == Request.GET_STATUS:
            return build_status(Status(running=self.running))[:size]
        if request == Request.SET_RATE:
            self.rate_hz = value
            return b""
        self.running = request == Request.START
        if self.running:
            self.rate_hz = value
            self.started()
        return b""

    def transfer(self, size: int, timeout_ms: int, generation: int) -> bytes:
        """Return one IN transfer of at most `size` bytes."""
        until = None if timeout_ms == 0 else time.monotonic() + timeout_ms / 1000
        got = b""
        with self._changed:
            while len(got) < size:
                if not self._rest:
                    item = self._next(until, generation)
                    if item is None:
                        if got:
                            return got  # pyusb hands out what came before a timeout
                        raise usb_error(errno.ETIMEDOUT)
                    if isinstance(item, int):
                        self.halted = item == errno.EPIPE
                        raise usb_error(item)
                    self._rest, self._ends_short = item, len(item) % PACKET_BYTES != 0 or not item
                    if not item:
                        return got
                if len(self._rest) > size - len(got) and (size - len(got)) % PACKET_BYTES:
                    self._rest = b""
                    raise usb_error(errno.EOVERFLOW)
                take, self._rest = self._rest[: size - len(got)], self._rest[size - len(got) :]
                got += take
                if not self._rest and self._ends_short:
                    return got
        return got

    def _next(self, until: float | None, generation: int) -> Transfer | None:
        while True:
            if generation != self.generation or not self.present:
                raise usb_error(self.lost_on_unplug)
            if self.halted:
                return errno.EPIPE
            if self._queue:
                return self._queue.popleft()
            item = self.source() if self.running else None
            if item is not None:
                return item
            left = None if until is None else until - time.monotonic()
            if left is not None and left <= 0:
                return None
            self._changed.wait(left)


def steady(daq: FakeDaq, count: int = 5) -> None:
    """Let the device send this many frames after each START."""
    daq.started = lambda: daq.send(*[daq.frame() for _ in range(count)])


class _Handle:
    def __init__(self, daq: FakeDaq) -> None:
        self.daq = daq
        self.generation = daq.generation


class FakeBus(usb.backend.IBackend):  # type: ignore[misc]  # pyusb has no types
    """A pyusb backend with these devices on its bus."""

    def __init__(self, *daqs: FakeDaq) -> None:
        self.daqs = list(daqs)
        self.list_error = 0

    def enumerate_devices(self) -> Iterator[FakeDaq]:
        if self.list_error:
            raise usb_error(self.list_error)
        return iter([daq for daq in self.daqs if daq.present])

    def get_parent(self, daq: FakeDaq) -> None:  # noqa: ARG002 - pyusb's
        return None

    def get_device_descriptor(self, daq: FakeDaq) -> SimpleNamespace:
        return daq.device

    def get_configuration_descriptor(self, daq: FakeDaq, number: int) -> SimpleNamespace:
        return _at([daq.config], number)

    def get_interface_descriptor(self, daq: FakeDaq, number: int, alternate: int, _config: int) -> SimpleNamespace:
        return _at([daq.interface], number or alternate)

    def get_endpoint_descriptor(
        self, daq: FakeDaq, number: int, _interface: int, _alternate: int, _config: int
    ) -> SimpleNamespace:
        return _at([daq.endpoint], number)

    def open_device(self, daq: FakeDaq) -> _Handle:
        if daq.open_error or not daq.present:
            raise usb_error(daq.open_error or errno.ENODEV)
        daq.opened += 1
        return _Handle(daq)

    def close_device(self, handle: _Handle) -> None:
        handle.daq.closed += 1

    def set_configuration(self, handle: _Handle, value: int) -> None:
        _live(handle).configuration = value

    def get_configuration(self, handle: _Handle) -> int:
        return _live(handle).configuration

    def set_interface_altsetting(self, handle: _Handle, _interface: int, _alternate: int) -> None:
        _live(handle)

    def claim_interface(self, handle: _Handle, _interface: int) -> None:
        daq = _live(handle)
        if daq.kernel_driver or daq.claim_error:
            raise usb_error(daq.claim_error or errno.EBUSY)

    def release_interface(self, handle: _Handle, _interface: int) -> None:
        _live(handle)

    def is_kernel_driver_active(self, handle: _Handle, _interface: int) -> bool:
        return _live(handle).kernel_driver

    def detach_kernel_driver(self, handle: _Handle, _interface: int) -> None:
        _live(handle).kernel_driver = False

    def clear_halt(self, handle: _Handle, _endpoint: int) -> None:
        daq = _live(handle)
        daq.cleared += 1
        daq.halted = False

    def reset_device(self, handle: _Handle) -> None:
        daq = _live(handle)
        daq.resets += 1
        daq.unplug()
        daq.plug()

    def bulk_read(
        self, handle: _Handle, _endpoint: int, _interface: int, buffer: array.array[int], timeout_ms: int
    ) -> int:
        data = handle.daq.transfer(len(buffer) * buffer.itemsize, timeout_ms, handle.generation)
        memoryview(buffer).cast("B")[: len(data)] = data
        return len(data)

    def ctrl_transfer(
        self, handle: _Handle, kind: int, request: int, value: int, _index: int, data: array.array[int], _timeout: int
    ) -> int:
        daq = _live(handle)
        if (kind, request) == (0x80, 6) and value >> 8 == 3:  # GET_DESCRIPTOR of a string
            text = struct.pack("<H", 0x0409) if value & 255 == 0 else daq.strings[value & 255].encode("utf-16-le")
            answer = bytes([len(text) + 2, 3]) + text
        else:
            answer = daq.control(kind, request, value, len(data))
        answer = answer[: len(data)]
        memoryview(data).cast("B")[: len(answer)] = answer
        return len(answer)


def _live(handle: _Handle) -> FakeDaq:
    if not handle.daq.present or handle.generation != handle.daq.generation:
        raise usb_error(errno.ENODEV)
    return handle.daq


def _at(items: Sequence[SimpleNamespace], number: int) -> SimpleNamespace:
    if number >= len(items):
        raise IndexError(number)  # how pyusb learns that there are no more
    return items[number]
