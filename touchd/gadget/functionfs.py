"""A software DAQ on a real cable: FunctionFS of Linux carries its endpoints, ConfigFS makes it a USB device.

Documentation/usb/functionfs.rst and gadget_configfs.rst of the Linux sources describe the kernel's side.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import structlog

from touchd.errors import GadgetError
from touchd.gadget.device import Gadget
from touchd.sources.usb_protocol import INTERFACE_CLASS

ENDPOINT: Final = 0x81
_MAGIC_DESCRIPTORS_V2, _MAGIC_STRINGS = 3, 2
# Three speeds; and vendor requests with the device as recipient, which without this flag never reach a function.
_FULL_SPEED, _HIGH_SPEED, _SUPER_SPEED, _ALL_CONTROL = 1, 2, 4, 64
_EVENT = struct.Struct("<BBHHHB3x")  # a setup packet, and the type of the event
_DISABLE, _SETUP = 3, 4
_BULK, _ENGLISH = 2, 0x0409
_IDLE_S = 0.02
_NAME = "touchd"  # of the gadget and of its function
_NEEDED = "run it as root, on a kernel with USB gadgets (CONFIG_USB_CONFIGFS_F_FS): modprobe libcomposite"
# No host is connected, or a transfer is cut off: try again.
_AWAY = (errno.ESHUTDOWN, errno.ECONNRESET, errno.EAGAIN, errno.EINTR, errno.ENODEV, errno.EIO, errno.EBADFD)

log = structlog.get_logger()


def descriptors() -> bytes:
    """Return the first data for ep0: the interface and its endpoint at full, high and super speed."""
    interface = struct.pack("<9B", 9, 4, 0, 0, 1, *INTERFACE_CLASS, 1)

    def endpoint(packet_bytes: int) -> bytes:
        return struct.pack("<4BHB", 7, 5, ENDPOINT, _BULK, packet_bytes, 0)

    companion = struct.pack("<4BH", 6, 0x30, 0, 0, 0)
    body = struct.pack("<III", 2, 2, 3)
    for packet_bytes, rest in ((64, b""), (512, b""), (1024, companion)):
        body += interface + endpoint(packet_bytes) + rest
    flags = _FULL_SPEED | _HIGH_SPEED | _SUPER_SPEED | _ALL_CONTROL
    return struct.pack("<III", _MAGIC_DESCRIPTORS_V2, 12 + len(body), flags) + body


def strings() -> bytes:
    """Return the next data for ep0: the interface's name."""
    text = struct.pack("<H", _ENGLISH) + b"touchd DAQ\0"
    return struct.pack("<IIII", _MAGIC_STRINGS, 16 + len(text), 1, 1) + text


class FunctionFs:
    """Serve a gadget's endpoints in a folder where FunctionFS is mounted, by two threads, until the process ends.

    `folder` holds `ep0`, and `ep1` once the descriptors are written to `ep0`. Raises GadgetError if FunctionFS is not
    mounted there, or the kernel does not take the descriptors.
    """

    def __init__(self, folder: Path, gadget: Gadget) -> None:
        self._gadget = gadget
        try:
            self._ep0 = os.open(folder / "ep0", os.O_RDWR)
            os.write(self._ep0, descriptors())
            os.write(self._ep0, strings())
            self._ep1 = os.open(folder / "ep1", os.O_RDWR)
        except OSError as error:
            raise GadgetError(
                f"FunctionFS cannot be used ({error.strerror})", str(folder), "mount it: mount -t functionfs NAME DIR"
            ) from error
        self._asked = threading.Event()
        self.error: GadgetError | None = None
        """Why a thread has ended."""
        for serve in (self.serve_control, self.serve_frames):
            threading.Thread(target=self._guard, args=(serve,), daemon=True, name=f"gadget-{serve.__name__}").start()

    def serve_control(self) -> None:
        """Answer requests until ep0 is closed."""
        while event := os.read(self._ep0, _EVENT.size):
            kind, request, value, _, length, event_type = _EVENT.unpack(event)
            if event_type == _DISABLE:
                self._gadget.running = False
            elif event_type == _SETUP:
                answer = self._gadget.control(kind, request, value, length)
                log.debug("request", kind=kind, request=request, value=value, stalled=answer is None)
                self._answer(answer, to_host=bool(kind & 0x80))
                self._asked.set()

    def serve_frames(self) -> None:
        """Send each frame when it is due, until the process ends."""
        while True:
            transfer = self._gadget.next_transfer()
            try:
                if transfer is None:
                    self._asked.wait(min(self._gadget.wait_s(), _IDLE_S))
                    self._asked.clear()
                elif isinstance(transfer, int):
                    os.read(self._ep1, 1)  # in the wrong direction: halts the endpoint
                else:
                    os.write(self._ep1, transfer)
            except OSError as error:
                if error.errno == errno.EBADMSG:  # how the kernel confirms a halt
                    continue
                if error.errno not in _AWAY:
                    raise
                time.sleep(_IDLE_S)

    def _answer(self, answer: bytes | None, *, to_host: bool) -> None:
        """Send an answer, acknowledge, or stall: FunctionFS stalls after a transfer in the wrong direction."""
        try:
            if answer is None:
                os.read(self._ep0, 0) if to_host else os.write(self._ep0, b"")
            elif to_host:
                os.write(self._ep0, answer)
            else:
                os.read(self._ep0, 0)
        except OSError as error:
            # EL2HLT confirms a stall; EIDRM: the host has cancelled its request.
            if error.errno not in (errno.EL2HLT, errno.EIDRM, *_AWAY):
                raise

    def _guard(self, serve: Callable[[], None]) -> None:
        try:
            serve()
        except Exception as error:
            self.error = GadgetError(f"the device has failed: {error!r}", "FunctionFS", "start it again")
            self.error.__cause__ = error


class ConfigFs:
    """A USB device with one function in ConfigFS; needs root.

    `root` and `mounts` are the folders in which to make the gadget, and to mount its FunctionFS.
    """

    def __init__(
        self,
        serial: str,
        vendor_id: int,
        product_id: int,
        *,
        root: Path = Path("/sys/kernel/config/usb_gadget"),
        mounts: Path = Path("/dev"),
    ) -> None:
        self.folder = mounts / f"ffs-{_NAME}"
        """Holds the endpoints after `create`."""
        self._gadget = root / _NAME
        self._function = self._gadget / "functions" / f"ffs.{_NAME}"
        self._link = self._gadget / "configs" / "c.1" / self._function.name
        self._files = {
            "idVendor": f"{vendor_id:#06x}", "idProduct": f"{product_id:#06x}", "bcdDevice": "0x0100",
            "strings/0x409/serialnumber": serial, "strings/0x409/manufacturer": "touchd",
            "strings/0x409/product": "touchd reference DAQ", "configs/c.1/strings/0x409/configuration": "stream",
        }  # fmt: skip

    def create(self) -> None:
        """Make the device, replace one that an earlier process left behind, and mount its FunctionFS.

        Raises GadgetError if the process is not root, or the kernel has no support.
        """
        for module in ("libcomposite", "usb_f_fs"):
            with contextlib.suppress(GadgetError):  # may be built in
                _run("modprobe", "-q", module)
        if not self._gadget.parent.is_dir():
            _run("mount", "-t", "configfs", "none", str(self._gadget.parent.parent))
        self.remove()
        try:
            for folder in ("strings/0x409", "configs/c.1/strings/0x409"):
                (self._gadget / folder).mkdir(parents=True, exist_ok=True)
            self._function.mkdir(parents=True, exist_ok=True)
            for name, text in self._files.items():
                (self._gadget / name).write_text(text)
            self._link.symlink_to(self._function)
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise GadgetError(
                f"the USB device cannot be made ({error.strerror})",
                str(error.filename or self._gadget),
                _NEEDED,
            ) from error
        _run("mount", "-t", "functionfs", _NAME, str(self.folder))

    def plug(self, udc: str) -> None:
        """Connect the device to a port, a name in /sys/class/udc; `FunctionFs` must serve its endpoints by then."""
        try:
            (self._gadget / "UDC").write_text(udc)
        except OSError as error:
            raise GadgetError(
                f"the port {udc.strip()!r} cannot be used ({error.strerror})", "--udc",
                "name one of /sys/class/udc that no other gadget uses",
            ) from error  # fmt: skip

    def unplug(self) -> None:
        """Disconnect the device, as a pulled cable does."""
        with contextlib.suppress(GadgetError):  # it was not connected
            self.plug("\n")

    def remove(self) -> None:
        """Remove what `create` made, as far as it exists."""
        if not self._gadget.is_dir():
            return
        self.unplug()
        if self.folder.is_mount():
            _run("umount", "-l", str(self.folder))
        with contextlib.suppress(OSError):
            self._link.unlink(missing_ok=True)
        for folder in (
            self.folder, self._gadget / "configs/c.1/strings/0x409", self._gadget / "configs/c.1", self._function,
            self._gadget / "strings/0x409", self._gadget,
        ):  # fmt: skip
            with contextlib.suppress(OSError):
                folder.rmdir()


def first_udc(ports: Path = Path("/sys/class/udc")) -> str:
    """Return the name of the first port that can be a USB device; raises GadgetError without one."""
    with contextlib.suppress(OSError):
        for port in sorted(ports.iterdir()):
            return port.name
    raise GadgetError(
        "this computer has no port that can be a USB device", "--udc",
        "use a board with one (and its driver, such as dwc2), or load dummy_hcd to test without a cable",
    )  # fmt: skip


def _run(*command: str) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - arguments of our own
    except OSError as error:  # PATH of a root's shell after `su` lacks /sbin
        raise GadgetError(f"cannot be run ({error.strerror})", command[0], _NEEDED) from error
    if done.returncode:
        why = done.stderr.strip().partition("\n")[0]
        raise GadgetError(f"{command[0]} failed: {why}", command[-1], _NEEDED)
