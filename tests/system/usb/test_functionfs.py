"""The DAQ on a real cable: what it tells the kernel, and, through the kernel's rules, what a host gets from it."""

from __future__ import annotations

import errno
import os
import queue
import struct
import subprocess
import threading
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from tests.processes import PATIENCE_S, touchd
from tests.system.usb.backend import FakeBus, FakeDaq, Transfer, usb_error
from tests.system.usb.reader import Reader
from touchd.cli.gadget import info_of, samples_of
from touchd.config.schema import DeviceSettings
from touchd.errors import GadgetError
from touchd.gadget import functionfs
from touchd.gadget.device import Gadget
from touchd.gadget.functionfs import ConfigFs, FunctionFs, descriptors, first_udc, strings
from touchd.sources.simulated import SimulatedSource
from touchd.sources.usb import candidates, open_usb
from touchd.sources.usb_protocol import Info, Status, build_info, build_status
from touchd.sources.usb_stream import acquisition_of
from touchd.twin.instrument import Instrument

EP0, EP1 = 100, 101
INFO = Info(channels=4, samples=250, sample_rate_hz=250_000, max_frame_rate_hz=1000, min_frame_rate_hz=10)
ENABLE, DISABLE, SETUP = 2, 3, 4


class Kernel:
    """FunctionFS by its rules, in place of the module `os`: ep0 with its events, and one bulk IN endpoint."""

    O_RDWR = os.O_RDWR

    def __init__(self) -> None:
        self.descriptors = self.strings = b""
        self.answers: queue.Queue[bytes | int] = queue.Queue()
        """To each setup packet: data, b"" for an acknowledgement, or EPIPE for a stall."""
        self.transfers: queue.Queue[Transfer] = queue.Queue(1)
        self.connected = threading.Event()
        self._events: queue.Queue[bytes] = queue.Queue()
        self._pending: int | None = None

    def open(self, path: Path, _flags: int) -> int:
        if path.name == "ep1":
            assert self.strings, "there is no ep1 before the descriptors and strings are known"
        return {"ep0": EP0, "ep1": EP1}[path.name]

    def event(self, kind: int, setup: bytes = bytes(8)) -> None:
        self._events.put(setup + bytes([kind, 0, 0, 0]))

    def setup(self, kind: int, request: int, value: int, length: int) -> bytes | int:
        """Send a request as a host does, and return what comes of it."""
        self.event(SETUP, struct.pack("<BBHHH", kind, request, value, 0, length))
        return self.answers.get(timeout=PATIENCE_S)

    def write(self, handle: int, data: bytes) -> int:
        if handle == EP1:
            if not self.connected.is_set():
                raise OSError(errno.ESHUTDOWN, "ESHUTDOWN")
            self.transfers.put(data)
        elif not self.descriptors:
            self.descriptors = data
        elif not self.strings:
            self.strings = data
        elif self._pending is None:
            raise OSError(errno.EIDRM, "EIDRM")
        else:
            self._finish(data if self._pending & 0x80 else errno.EPIPE)
        return len(data)

    def read(self, handle: int, size: int) -> bytes:
        if handle == EP1:
            self.transfers.put(errno.EPIPE)
            raise OSError(errno.EBADMSG, "EBADMSG")
        if self._pending is not None:
            self._finish(errno.EPIPE if self._pending & 0x80 else b"")
            return b""
        assert size == 12
        event = self._events.get()
        if event and event[8] == SETUP:
            self._pending = event[0]
        if event and event[8] == ENABLE:
            self.connected.set()
        if event and event[8] == DISABLE:
            self.connected.clear()
        return event

    def _finish(self, answer: bytes | int) -> None:
        self._pending = None
        self.answers.put(answer)
        if isinstance(answer, int):
            raise OSError(errno.EL2HLT, "EL2HLT")

    def close(self) -> None:
        self._events.put(b"")


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Any:
    made = Kernel()
    monkeypatch.setattr(functionfs, "os", made)
    yield made
    made.close()


class Wired(FakeDaq):
    """A device on the bus in memory that is the gadget behind the kernel's files."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__(INFO)
        self.kernel = kernel
        kernel.event(ENABLE)

    def control(self, kind: int, request: int, value: int, size: int) -> bytes:
        answer = self.kernel.setup(kind, request, value, size)
        if isinstance(answer, int):
            raise usb_error(answer)
        self.running = True
        return answer

    def _next(self, until: float | None, generation: int) -> Transfer | None:  # noqa: ARG002 - that of a FakeDaq
        try:
            return self.kernel.transfers.get(timeout=0.02)
        except queue.Empty:
            return None


def only_control(gadget: Gadget, monkeypatch: pytest.MonkeyPatch) -> FunctionFs:
    """The endpoints of a gadget that sends nothing."""
    monkeypatch.setattr(FunctionFs, "serve_frames", lambda _self: None)
    return FunctionFs(Path("/ffs"), gadget)


def test_descriptors() -> None:
    """The kernel gets one vendor interface with one bulk IN endpoint at each of three speeds."""
    data = descriptors()
    magic, length, flags, *counts = struct.unpack_from("<6I", data)
    assert (magic, length, flags, counts) == (3, len(data), 1 | 2 | 4 | 64, [2, 2, 3])
    at, found = 24, []
    while at < len(data):
        found.append(data[at : at + data[at]])
        at += data[at]
    assert at == len(data)
    interfaces = [d for d in found if d[1] == 4]
    assert [tuple(d[4:8]) for d in interfaces] == [(1, 0xFF, 0x54, 0x01)] * 3
    endpoints = [struct.unpack("<4BHB", d) for d in found if d[1] == 5]
    assert [(address, kind, size) for _, _, address, kind, size, _ in endpoints] == [
        (0x81, 2, size) for size in (64, 512, 1024)
    ]
    magic, length, languages, count_ = struct.unpack_from("<4I", strings()[:16].ljust(16, b"\0"))
    assert (magic, length, languages, count_) == (2, len(strings()), 1, 1)


def test_requests(kernel: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each request is answered, acknowledged or stalled."""
    gadget = Gadget(INFO, iter([]))
    only_control(gadget, monkeypatch)
    requests = [(0xC0, 1, 0, 64), (0x40, 2, 125, 0), (0x40, 3, 0, 0), (0xC0, 0x55, 0, 64), (0x40, 2, 60_000, 0)]
    running, answers = [], []
    for request in requests:
        answers.append(kernel.setup(*request))
        running.append(gadget.running)
    assert answers == [build_info(INFO), b"", b"", errno.EPIPE, errno.EPIPE]
    assert running == [False, True, False, False, False]
    assert kernel.setup(0xC0, 4, 0, 32) == build_status(Status(running=False))


def test_host_goes_away(kernel: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stream stops when the host goes away."""
    gadget = Gadget(INFO, iter([]))
    only_control(gadget, monkeypatch)
    assert kernel.setup(0x40, 2, 125, 0) == b""
    kernel.event(DISABLE)
    assert kernel.setup(0xC0, 4, 0, 32) == build_status(Status(running=False))


def test_kernel_refuses(kernel: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel that takes no descriptors is a GadgetError that names the folder."""

    def refuse(_handle: int, _data: bytes) -> int:
        raise OSError(errno.EINVAL, "Invalid argument")

    monkeypatch.setattr(kernel, "write", refuse)
    with pytest.raises(GadgetError, match="/ffs: FunctionFS cannot be used"):
        FunctionFs(Path("/ffs"), Gadget(INFO, iter([])))


def test_thread_fails(kernel: Kernel) -> None:
    """The error of a thread that fails is kept for the command."""

    def broken() -> Any:
        yield bytes(2000)
        raise ZeroDivisionError

    endpoints = FunctionFs(Path("/ffs"), Gadget(INFO, broken()))
    kernel.event(ENABLE)
    kernel.setup(0x40, 2, 20, 0)
    kernel.transfers.get(timeout=PATIENCE_S)
    until = threading.Event()
    for _ in range(1000):
        if endpoints.error:
            break
        until.wait(0.01)
    assert isinstance(endpoints.error, GadgetError)
    assert "ZeroDivisionError" in str(endpoints.error)


def test_host_and_gadget(kernel: Kernel) -> None:
    """A host reads every frame of the gadget that is no fault, and counts the faults."""
    gadget = Gadget(INFO, (i.to_bytes(2, "little") * 1000 for i in count()))
    FunctionFs(Path("/ffs"), gadget)
    daq = Wired(kernel)
    (opener,) = candidates(DeviceSettings(), FakeBus(daq))
    found = opener()
    assert (found.acquisition, found.min_rate_hz, found.max_rate_hz) == (acquisition_of(INFO), 10, 1000)
    assert not gadget.running
    found.close()
    source = open_usb(DeviceSettings(rate_hz=100, stall_s=10), acquisition_of(INFO), backend=FakeBus(daq))
    reader = Reader(source)
    try:
        reader.until_frames(10)
        for fault in ("corrupt", "short", "halt"):
            gadget.command(fault)
            before = len(reader.frames)
            reader.until(lambda before=before: len(reader.frames) > before + 5)  # type: ignore[misc]  # bound at once
        gadget.command("silent")
        while reader.step() is not None:  # what is still on its way counts too
            pass
    finally:
        source.close()
    assert source.tally.corrupt == 2
    assert daq.cleared == 1
    assert reader.states == ["streaming"]
    numbers = reader.sequence
    assert len(numbers) + source.tally.corrupt + source.tally.lost == numbers[-1] - numbers[0] + 1
    # Each frame holds its number, unless the scene was wound on for a host that was late.
    assert [int(f.counts[0, 0]) for f in reader.frames[:5]] == numbers[:5]
    assert not gadget.running, "closing the source stopped the stream"


def test_twin(instrument: Instrument) -> None:
    """The gadget streams the twin's frames, and GET_INFO describes the twin."""
    source = SimulatedSource("idle", paced=False, instrument=instrument, seed=3)
    again = SimulatedSource("idle", paced=False, instrument=instrument, seed=3)
    assert acquisition_of(info_of(source.acquisition)) == source.acquisition
    samples = samples_of(source)
    for _ in range(3):
        frame = again.read(10.0)
        assert frame is not None
        assert next(samples) == b"".join(column.astype("<i2").tobytes() for column in frame.counts.T)
    source.close()
    assert list(samples) == []
    again.close()


def test_configfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device is made in ConfigFS, plugged in, unplugged and removed."""
    ran: list[tuple[str, ...]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        ran.append(tuple(command))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    (tmp_path / "gadgets").mkdir()
    device = ConfigFs("SN7", 0x1209, 0x0001, root=tmp_path / "gadgets", mounts=tmp_path)
    device.create()
    made = tmp_path / "gadgets" / "touchd"
    assert (made / "idVendor").read_text() == "0x1209"
    assert (made / "strings/0x409/serialnumber").read_text() == "SN7"
    assert (made / "configs/c.1/ffs.touchd").resolve() == made / "functions/ffs.touchd"
    assert ran[-1] == ("mount", "-t", "functionfs", "touchd", str(tmp_path / "ffs-touchd"))
    device.plug("dummy_udc.0")
    assert (made / "UDC").read_text() == "dummy_udc.0"
    device.unplug()
    assert (made / "UDC").read_text() == "\n"
    device.remove()
    assert not (made / "configs/c.1/ffs.touchd").is_symlink()
    assert not (tmp_path / "ffs-touchd").exists()


def test_no_configfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel without ConfigFS is named as what is missing, in one line."""

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 32, "", "mount: mount point does not exist.\n  dmesg(1) has more")

    monkeypatch.setattr(subprocess, "run", run)
    with pytest.raises(GadgetError, match=r"does not exist\. -> run it as root, .*modprobe libcomposite$"):
        ConfigFs("SN7", 0x1209, 0x0001, root=tmp_path / "none/usb_gadget").create()


def test_no_mount(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a shell without /sbin in its PATH, as `su` leaves it, the program that is missing is named."""
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(GadgetError, match=r"^mount: cannot be run \(No such file or directory\) -> "):
        ConfigFs("SN7", 0x1209, 0x0001, root=tmp_path / "none/usb_gadget").create()


def test_first_port(tmp_path: Path) -> None:
    """The first port is used; a computer without one is a GadgetError."""
    with pytest.raises(GadgetError, match="no port that can be a USB device"):
        first_udc(tmp_path / "none")
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
    assert first_udc(tmp_path) == "a"


def test_no_gadget_support(tmp_path: Path) -> None:
    """A computer that cannot be a device says so in one line."""
    ended = touchd("gadget", "--functionfs", tmp_path, "--simulate", "idle")
    assert ended.code == GadgetError.exit_code
    assert len(ended.err.splitlines()) == 1
    assert "mount -t functionfs" in ended.err
