"""A DAQ behind a mocked kernel: umockdev answers the usbfs calls of a program that runs real pyusb and libusb.

`LD_PRELOAD=libumockdev-preload.so.0 /usr/bin/python3 mockkernel.py UNTOUCHED TOUCHED COMMAND...` starts COMMAND with
the device plugged in, obeys lines on standard input (see client.py), and ends with COMMAND. It needs Debian's
python3-gi, gir1.2-umockdev-1.0 and umockdev, and of touchd only what needs no package.

An ioctl is answered in one thread, in order. libusb asks for finished transfers without waiting (REAPURBNDELAY), so an
empty answer is held back for some milliseconds while transfers are in flight: otherwise it would ask without pause.
"""

from __future__ import annotations

import errno
import os
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402 - after the version is chosen

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))
from tests.system.usb.player import Player  # noqa: E402 - after the path is known
from touchd.gadget.device import Gadget  # noqa: E402 - as above
from touchd.sources.usb_protocol import INTERFACE_CLASS, Info  # noqa: E402 - as above

INFO = Info(channels=4, samples=250, sample_rate_hz=250_000, min_frame_rate_hz=10, firmware=(1, 2, 3))
HOLD_S = 0.005
_TICK_S = 0.0005

# linux/usbdevice_fs.h, on a 64-bit computer.
URB = struct.Struct("=BBxxiIxxxxQiiiiiIQ")
CONTROL = 2
SETCONFIGURATION, SETINTERFACE, GETDRIVER = 0x80045505, 0x80085504, 0x41045508
SUBMITURB, DISCARDURB, REAPURB, REAPURBNDELAY = 0x8038550A, 0x550B, 0x4008550C, 0x4008550D
CLAIMINTERFACE, RELEASEINTERFACE, RESET, CLEAR_HALT = 0x8004550F, 0x80045510, 0x5514, 0x80045515
GET_CAPABILITIES, GET_SPEED = 0x8004551A, 0x551F
HIGH_SPEED = 3

DEVICE = struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x200, 0xFF, 0, 0, 64, 0x1209, 0x0001, 0x100, 1, 2, 3, 1)
INTERFACE = struct.pack("<9B", 9, 4, 0, 0, 1, *INTERFACE_CLASS, 0) + struct.pack("<4BHB", 7, 5, 0x81, 2, 512, 0)
CONFIGURATION = struct.pack("<BBHBBBBB", 9, 2, 9 + len(INTERFACE), 1, 1, 0, 0x80, 50) + INTERFACE
STRINGS = {1: "touchd", 2: "DAQ behind a mocked kernel", 3: "SN0001"}


class InFlight:
    """A submitted transfer."""

    def __init__(self, memory: Any) -> None:
        self.memory = memory
        self.fields = list(URB.unpack(bytes(memory.retrieve())))
        self.kind, self.size = self.fields[0], self.fields[5]

    def data(self) -> bytes:
        """What the program has put into the transfer's buffer."""
        return bytes(self.memory.resolve(16, self.size).retrieve())

    def finish(self, result: bytes | int) -> None:
        """Write the result where the program looks for it: data, or a negative errno."""
        if isinstance(result, int):
            self.fields[2] = result
        else:
            self.fields[2], self.fields[6] = 0, len(result)
            if result:
                # A control transfer's buffer begins with its setup packet.
                self.memory.resolve(16, self.size).update(8 if self.kind == CONTROL else 0, result)
        self.memory.update(0, URB.pack(*self.fields))


class MockedKernel:
    """One port with the device in it, or not."""

    def __init__(self, gadget: Gadget) -> None:
        self.gadget = gadget
        self.gone = True
        self._testbed = UMockdev.Testbed.new()
        self._ioctls = UMockdev.IoctlBase.new()
        self._ioctls.connect("handle-ioctl", self._handle)
        self._flying: list[InFlight] = []
        self._finished: list[InFlight] = []
        self._address = 1
        self._client: Any = None

    @property
    def environment(self) -> dict[str, str]:
        """What makes a program see this kernel."""
        return {**os.environ, "UMOCKDEV_DIR": self._testbed.get_root_dir()}

    def plug(self) -> None:
        """Plug the device in, with an address it never had before."""
        self._address += 1
        self._node = f"/dev/bus/usb/001/{self._address:03d}"
        self.gone = False
        self._testbed.attach_ioctl(self._node, self._ioctls)
        self._testbed.add_from_string(
            f"P: /devices/usb1/1-1\nN: {self._node.removeprefix('/dev/')}\nE: SUBSYSTEM=usb\nE: DRIVER=usb\n"
            f"E: BUSNUM=001\nE: DEVNUM={self._address:03d}\nE: DEVNAME={self._node}\nE: DEVTYPE=usb_device\n"
            f"A: busnum=1\\n\nA: devnum={self._address}\\n\nA: bConfigurationValue=1\\n\nA: speed=480\\n\n"
            f"A: idVendor=1209\\n\nA: idProduct=0001\\n\nH: descriptors={(DEVICE + CONFIGURATION).hex().upper()}\n"
        )
        self._testbed.uevent("/sys/devices/usb1/1-1", "add")

    def unplug(self) -> None:
        """Pull the cable: transfers come back with ESHUTDOWN, everything else fails with ENODEV."""
        if self.gone:
            return
        self.gone, self.gadget.running = True, False
        self._testbed.uevent("/sys/devices/usb1/1-1", "remove")
        self._testbed.remove_device("/sys/devices/usb1/1-1")
        self._testbed.detach_ioctl(self._node)

    def _handle(self, _base: Any, client: Any) -> bool:
        if client is not self._client:
            # Opened anew, or by another program: what a killed one left in flight is gone with its memory.
            self._client, self._flying, self._finished = client, [], []
        try:
            return self._serve(client)
        except GLib.Error as error:
            print(f"mockkernel: the program is gone: {error.message}", file=sys.stderr, flush=True)
            return True

    def _serve(self, client: Any) -> bool:
        request = client.get_request() & 0xFFFFFFFF
        argument = client.props.arg
        if self.gone and request not in (REAPURB, REAPURBNDELAY, DISCARDURB):
            client.complete(-1, errno.ENODEV)
        elif request == GET_CAPABILITIES:
            argument.resolve(0, 4).update(0, struct.pack("=I", 0x1F))
            client.complete(0, 0)
        elif request == GETDRIVER:
            client.complete(-1, errno.ENODATA)
        elif request == GET_SPEED:
            client.complete(HIGH_SPEED, 0)
        elif request in (CLAIMINTERFACE, RELEASEINTERFACE, SETCONFIGURATION, SETINTERFACE, CLEAR_HALT, RESET):
            client.complete(0, 0)
        elif request == SUBMITURB:
            self._flying.append(InFlight(argument.resolve(0, URB.size)))
            client.complete(0, 0)
        elif request in (REAPURB, REAPURBNDELAY):
            self._reap(client, argument)
        elif request == DISCARDURB:
            self._discard(client)
        else:
            print(f"mockkernel: unknown ioctl {request:#x}", file=sys.stderr, flush=True)
            return False
        return True

    def _discard(self, client: Any) -> None:
        """Take back the transfer in flight: the program under test has one at a time."""
        if not self._flying:
            client.complete(-1, errno.EINVAL)
            return
        transfer = self._flying.pop(0)
        transfer.finish(-errno.ENOENT)
        self._finished.append(transfer)
        client.complete(0, 0)

    def _reap(self, client: Any, argument: Any) -> None:
        until = time.monotonic() + HOLD_S
        while True:
            if not self._finished and self._flying:
                result: bytes | int | None = -errno.ESHUTDOWN if self.gone else self._answer(self._flying[0])
                if result is not None:
                    transfer = self._flying.pop(0)
                    transfer.finish(result)
                    self._finished.append(transfer)
            if self._finished:
                argument.resolve(0, 8).set_ptr(0, self._finished.pop(0).memory)
                client.complete(0, 0)
                return
            if not self._flying or time.monotonic() >= until:
                client.complete(-1, errno.ENODEV if self.gone else errno.EAGAIN)
                return
            time.sleep(_TICK_S)

    def _answer(self, transfer: InFlight) -> bytes | int | None:
        """What the device makes of a transfer; None while it has nothing to say."""
        if transfer.kind != CONTROL:
            sent = self.gadget.next_transfer()
            if isinstance(sent, int):
                return -sent
            return -errno.EOVERFLOW if sent is not None and len(sent) > transfer.size else sent
        kind, request, value, _, length = struct.unpack("<BBHHH", transfer.data()[:8])
        if (kind, request) == (0x80, 6):
            descriptor = self._descriptor(value >> 8, value & 0xFF)
            return -errno.EPIPE if descriptor is None else descriptor[:length]
        answer = self.gadget.control(kind, request, value, length)
        return -errno.EPIPE if answer is None else answer

    @staticmethod
    def _descriptor(kind: int, number: int) -> bytes | None:
        if kind == 3:
            text = b"\x09\x04" if number == 0 else STRINGS.get(number, "").encode("utf-16-le")
            return bytes([len(text) + 2, 3]) + text
        return {1: DEVICE, 2: CONFIGURATION}.get(kind)


def frames_of(path: str) -> list[bytes]:
    """Cut a file into the samples of frames."""
    data, size = Path(path).read_bytes(), 2 * INFO.channels * INFO.samples
    return [data[i : i + size] for i in range(0, len(data), size)]


def main() -> int:
    """Run a program against the mocked kernel, steered from standard input."""
    untouched, touched, *command = sys.argv[1:]
    player = Player(frames_of(untouched), frames_of(touched))
    kernel = MockedKernel(Gadget(INFO, player))
    kernel.plug()
    child = subprocess.Popen(command, env=kernel.environment, stdin=subprocess.DEVNULL)
    loop = GLib.MainLoop()

    def obey() -> None:
        for line in sys.stdin:
            name = line.strip().removeprefix("!")
            if name in ("plug", "unplug"):
                getattr(kernel, name)()
            elif name in ("touch", "release"):
                player.touch(name == "touch")
            elif name:
                kernel.gadget.command(name)
        child.terminate()

    def wait() -> None:
        child.wait()
        loop.quit()

    for run in (obey, wait):
        threading.Thread(target=run, daemon=True).start()
    loop.run()
    return child.returncode


if __name__ == "__main__":
    # Not sys.exit: the thread that reads standard input may hold its lock.
    code = main()
    sys.stdout.flush()
    os._exit(code & 0xFF)
