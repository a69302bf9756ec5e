"""A DAQ on the kernel's USB/IP port, for faults that no gadget can make: halts, overflows, a connection that breaks.

`python3 usbipdaq.py UNTOUCHED TOUCHED` plugs it in and obeys lines on standard input, those of `client.py`; `pull`
breaks the connection without a word. It needs root, the module vhci_hcd, and of touchd only what needs no package.
The protocol is described in Documentation/usb/usbip_protocol.rst of the Linux sources.
"""

from __future__ import annotations

import errno
import select
import socket
import struct
import sys
import threading
from pathlib import Path

from player import Player  # type: ignore[import-not-found]  # beside this file, where it runs

from touchd.gadget.device import Gadget
from touchd.sources.usb_protocol import INTERFACE_CLASS, Info

PORT = Path("/sys/devices/platform/vhci_hcd.0")
INFO = Info(channels=4, samples=250, sample_rate_hz=250_000, min_frame_rate_hz=10, firmware=(1, 2, 3))
HIGH_SPEED, DEVICE_ID = 3, 0x10002
SUBMIT, UNLINK, RETURN_SUBMIT, RETURN_UNLINK = 1, 2, 3, 4
HEADER = struct.Struct(">IIIIIiiiii8s")
POLL_S = 0.002

DEVICE = struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x200, 0xFF, 0, 0, 64, 0x1209, 0x0001, 0x100, 1, 2, 3, 1)
INTERFACE = struct.pack("<9B", 9, 4, 0, 0, 1, *INTERFACE_CLASS, 0) + struct.pack("<4BHB", 7, 5, 0x81, 2, 512, 0)
CONFIGURATION = struct.pack("<BBHBBBBB", 9, 2, 9 + len(INTERFACE), 1, 1, 0, 0x80, 50) + INTERFACE
STRINGS = {1: "touchd", 2: "DAQ on USB/IP", 3: "SN0002"}


class UsbIpDaq:
    """The device's end of a connection to the kernel's virtual host controller."""

    def __init__(self, gadget: Gadget) -> None:
        self.gadget = gadget
        self._socket: socket.socket | None = None
        self._waiting: list[tuple[int, int]] = []  # sequence number and size of reads that await a frame

    def plug(self) -> None:
        """Attach a new connection to the first port."""
        kernel, self._socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._waiting = []
        (PORT / "attach").write_text(f"0 {kernel.fileno()} {DEVICE_ID} {HIGH_SPEED}")
        kernel.close()
        threading.Thread(target=self._serve, args=(self._socket,), daemon=True).start()

    def unplug(self) -> None:
        """Detach the port."""
        self.gadget.running = False
        (PORT / "detach").write_text("0")

    def pull(self) -> None:
        """Break the connection."""
        self.gadget.running = False
        if self._socket is not None:
            self._socket.shutdown(socket.SHUT_RDWR)

    def _serve(self, connection: socket.socket) -> None:
        buffer = bytearray()
        try:
            while True:
                self._send_frames(connection)
                if not select.select([connection], [], [], POLL_S if self._waiting else None)[0]:
                    continue
                data = connection.recv(65536)
                if not data:
                    return
                buffer += data
                while len(buffer) >= HEADER.size and self._take(connection, buffer):
                    pass
        except OSError:
            return

    def _send_frames(self, connection: socket.socket) -> None:
        while self._waiting:
            sent = self.gadget.next_transfer()
            if sent is None:
                return
            sequence, size = self._waiting.pop(0)
            if isinstance(sent, int):
                self._return(connection, sequence, -sent)
            elif len(sent) > size:
                self._return(connection, sequence, -errno.EOVERFLOW)
            else:
                self._return(connection, sequence, 0, sent)

    def _take(self, connection: socket.socket, buffer: bytearray) -> bool:
        """Serve one request; False if it is not complete yet."""
        command, sequence, _, to_host, endpoint, flags, size, *_, setup = HEADER.unpack_from(buffer)
        sent = size if command == SUBMIT and not to_host else 0
        if len(buffer) < HEADER.size + sent:
            return False
        del buffer[: HEADER.size + sent]
        if command == UNLINK:
            # Of an unlink, the field behind the endpoint is the request to take back.
            there = [waiting for waiting in self._waiting if waiting[0] == flags]
            self._waiting = [waiting for waiting in self._waiting if waiting not in there]
            status = -errno.ECONNRESET if there else 0
            connection.sendall(HEADER.pack(RETURN_UNLINK, sequence, 0, 0, 0, status, 0, 0, 0, 0, bytes(8)))
        elif endpoint == 0:
            answer = self._control(*struct.unpack("<BBHHH", setup))
            self._return(connection, sequence, -errno.EPIPE if answer is None else 0, answer or b"")
        elif to_host:
            self._waiting.append((sequence, size))
        else:
            self._return(connection, sequence, 0)
        return True

    def _control(self, kind: int, request: int, value: int, _index: int, length: int) -> bytes | None:
        if (kind, request) == (0x80, 6):
            descriptor = _descriptor(value >> 8, value & 0xFF)
            return None if descriptor is None else descriptor[:length]
        if (kind, request) == (0x80, 0):  # GET_STATUS
            return b"\0\0"
        if (kind, request) == (0x80, 8):  # GET_CONFIGURATION
            return b"\1"
        if kind & 0x60 == 0:  # the other standard requests change nothing here
            return b""
        return self.gadget.control(kind, request, value, length)

    @staticmethod
    def _return(connection: socket.socket, sequence: int, status: int, data: bytes = b"") -> None:
        connection.sendall(
            HEADER.pack(RETURN_SUBMIT, sequence, 0, 0, 0, status, len(data), 0, 0, 0, bytes(8)) + data
        )  # fmt: skip


def _descriptor(kind: int, number: int) -> bytes | None:
    if kind == 3:
        text = b"\x09\x04" if number == 0 else STRINGS.get(number, "").encode("utf-16-le")
        return bytes([len(text) + 2, 3]) + text
    return {1: DEVICE, 2: CONFIGURATION}.get(kind)


def frames_of(path: str) -> list[bytes]:
    """Cut a file into the samples of frames."""
    data, size = Path(path).read_bytes(), 2 * INFO.channels * INFO.samples
    return [data[i : i + size] for i in range(0, len(data), size)]


def main() -> None:
    """Plug the device in, and obey until standard input ends."""
    player = Player(*map(frames_of, sys.argv[1:3]))
    daq = UsbIpDaq(Gadget(INFO, player))
    daq.plug()
    for line in sys.stdin:
        name = line.strip().removeprefix("!")
        if name in ("plug", "unplug", "pull"):
            getattr(daq, name)()
        elif name in ("touch", "release"):
            player.touch(name == "touch")
        elif name:
            daq.gadget.command(name)


if __name__ == "__main__":
    main()
