"""One daemon at a steady rate, behind the real USB reader, in a process of its own.

Run as a script under the `PYTHONPATH` of any tree of touchd, so it uses only what older trees have too. It prints one
line of JSON.
"""

from __future__ import annotations

import functools
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from itertools import cycle
from pathlib import Path
from statistics import median
from types import FrameType
from typing import Any

import numpy as np

from touchd.config.schema import LogSettings, Settings
from touchd.service import realtime
from touchd.service.daemon import load_model, make_pipeline
from touchd.service.log import configure
from touchd.service.loop import Service
from touchd.service.preroll import PreRoll
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.live import DaqSource
from touchd.sources.recorder import describe
from touchd.sources.usb_protocol import Header, Info, Request, build_frame
from touchd.sources.usb_stream import UsbDaq

STAGES = "USB read", "detection", "localization", "tracking", "message", "bus", "pre-roll"
"""Of a frame, beside its wake-up: what is left of its processor time."""
COUNTED = 50
"""Frames of which calls are counted."""
RAPL = Path("/sys/class/powercap/intel-rapl:0/energy_uj")


class Device:
    """A `Connection` of the USB room: frames come when they are due; building them is counted apart.

    The frames after the lead-in are played to and fro, at any rate; or, if `full_hz` is the rate that they were taken
    at, again and again by their times, so that a lower rate leaves some out.
    """

    packet_bytes, serial = 512, "bench"

    def __init__(self, frames: np.ndarray, lead: int, full_hz: int = 0) -> None:
        channels, samples = frames.shape[1:]
        self.info = Info(channels, samples, 250_000, capabilities=1)
        self._bodies = self._play([frame.T.astype("<i2").tobytes() for frame in frames], lead, full_hz)
        self._rate_hz, self._chirp_ns, self._sequence = 0, 0, 0
        self.own_cpu_s = 0.0
        self.due_ns: list[int] = []
        self.go = threading.Event()
        """Set once the daemon takes frames: the finger comes down after the plate is learned."""

    def command(self, request: Request, value: int = 0) -> None:
        """Start, or change the rate."""
        if request.name in ("START", "SET_RATE"):
            self._rate_hz = value

    def fill(self, buffer: array[int], timeout_ms: int) -> int | None:  # noqa: ARG002 - a frame is always due
        """Return the next frame when it is due."""
        before_s = time.thread_time()
        if not self._rate_hz:
            return None
        if not self.due_ns:
            self.go.wait()
            self._first_ns = self._chirp_ns = time.monotonic_ns()
        header = Header(self._sequence, self._chirp_ns // 1000)
        transfer = build_frame(self.info, header, next(self._bodies))
        buffer[: len(transfer)] = array("B", transfer)
        due_ns = self._chirp_ns + 1_000_000
        self.due_ns.append(due_ns)
        self._sequence += 1
        self._chirp_ns += 1_000_000_000 // self._rate_hz
        self.own_cpu_s += time.thread_time() - before_s
        while (left_ns := due_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns * 1e-9)
        return len(transfer)

    def _play(self, bodies: list[bytes], lead: int, full_hz: int) -> Iterator[bytes]:
        yield from bodies[:lead]
        there = bodies[lead:]
        if not full_hz:
            yield from cycle([*there, *there[-2:0:-1]])
        while True:
            # Rounded down: to the nearest, half a frame off, every other one would come twice, as from a hung device.
            yield there[((self._chirp_ns - self._first_ns) * full_hz // 1_000_000_000 - lead) % len(there)]

    def clear_halt(self) -> None:
        """Nothing is halted, nor to be reset."""

    reset = clear_halt

    def close(self) -> None:
        """End."""
        self._rate_hz = 0


def calls_of_frames() -> Iterator[dict[str, float] | None]:
    """Count at each step what the frame before it has called in this thread; the medians come last."""
    found: list[tuple[int, int]] = []
    ran: list[object] = []
    device = False

    def note(frame: FrameType, event: str, what: Any) -> None:
        nonlocal device
        code = frame.f_code
        if code is Device.fill.__code__ and event in ("call", "return"):
            device = event == "call"
        elif event in ("call", "c_call") and not device and code.co_filename != __file__:
            ran.append(code if event == "call" else what.__qualname__)

    for _ in range(COUNTED):
        ran.clear()
        sys.setprofile(note)
        yield None
        sys.setprofile(None)
        found.append((len(ran), len(set(ran))))
    calls, functions = zip(*found, strict=True)
    yield {"calls": median(calls), "functions": median(functions)}


def switches() -> dict[str, int]:
    """Return how often each thread has been switched to, by name."""
    found: dict[str, int] = {}
    for task in Path("/proc/self/task").iterdir():
        lines = dict(line.split(":", 1) for line in (task / "status").read_text().splitlines())
        count = int(lines["voluntary_ctxt_switches"]) + int(lines["nonvoluntary_ctxt_switches"])
        name = lines["Name"].strip() if int(task.name) != os.getpid() else "main"
        found[name] = found.get(name, 0) + count
    return found


def timed(owner: Any, name: str, taken: list[int], sign: int = 1) -> None:
    """Replace a method by one that adds each call's time, and its processor time, to two sums, ns; or subtracts it."""
    call: Callable[..., Any] = getattr(owner, name)
    wall, cpu = time.perf_counter_ns, time.thread_time_ns

    @functools.wraps(call)
    def noted(*args: Any, **kwargs: Any) -> Any:
        cpu_ns, wall_ns = cpu(), wall()
        try:
            return call(*args, **kwargs)
        finally:
            taken[0] += sign * (wall() - wall_ns)
            taken[1] += sign * (cpu() - cpu_ns)

    setattr(owner, name, noted)


def energy_uj() -> int | None:
    """Return the processor's energy counter, uJ; None where it has none, or only root may read it."""
    try:
        return int(RAPL.read_text())
    except (OSError, ValueError):
        return None


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Run the daemon, and return what it cost from `warm_s` on."""
    configure(LogSettings(level="error"))
    if task["cpus"]:
        os.sched_setaffinity(0, task["cpus"])
    settings = Settings.model_validate(task["settings"])
    model = load_model(settings)
    stored = np.load(task["frames"])
    device = Device(stored["frames"], int(stored["lead"]), task["full_hz"])
    daq = UsbDaq(device)
    source = DaqSource(lambda: iter([lambda: daq]), settings.device, daq.acquisition, lambda _: None)
    bus = ZeromqSink(settings.bus)
    meta = describe(source.acquisition, model.description.plate, settings.device.rate_hz, source="bench", device=None)
    kept: tuple[Any, ...] = (settings.device.rate_hz, lambda: meta, settings.preroll)
    try:
        preroll = PreRoll(*kept)
    except TypeError:  # a tree of before
        preroll = PreRoll(source.acquisition, *kept)  # type: ignore[arg-type]  # its pre-roll took the geometry first
    done: list[tuple[int, int, int]] = []  # number, arrival, and when the pre-roll had it, which is last
    stages = {stage: [0, 0] for stage in STAGES}
    service = Service(source, [bus], settings, make_pipeline(source, settings, model), preroll=preroll)
    if task["stages"]:
        pipeline = service.pipeline
        owned: dict[str, list[tuple[object, str]]] = {
            "USB read": [(daq, "read"), (source, "_take")],
            "detection": [(pipeline.detector, name) for name in ("detect", "clean", "adapt")],
            "localization": [(pipeline._localizer, name) for name in ("follow", "localize", "observe")],
            "tracking": [(pipeline._tracker, "track")], "message": [(service._messages, "make")],
            "bus": [(bus, "publish"), (bus, "poll")], "pre-roll": [(preroll, "keep")],
        }  # fmt: skip
        for stage, calls in owned.items():
            for owner, name in calls:
                if hasattr(owner, name):  # another checkout may do without
                    timed(owner, name, stages[stage])
        timed(device, "fill", stages["USB read"], -1)  # waits, and is the device's
    realtime.freeze()
    if task["subscriber"]:
        bus.wait_for_subscriber(20.0)
    begin: dict[str, Any] = {}
    ended: dict[str, Any] = {}

    def sample() -> dict[str, Any]:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return {
            "cpu_s": time.process_time() - device.own_cpu_s, "wall_s": time.monotonic(), "switches": switches(),
            "faults": usage.ru_minflt, "frames": len(done), "stages": {k: [*v] for k, v in stages.items()},
            "energy_uj": energy_uj(),
        }  # fmt: skip

    counting: list[subprocess.Popen[str]] = []
    clock, keep, steps = time.monotonic, preroll.keep, calls_of_frames()
    counted: dict[str, float] = {}
    since_s = clock()
    device.go.set()

    def watched(frame: Any, contacts: Any) -> None:
        done.append((frame.sequence, frame.received_ns, time.monotonic_ns()))
        keep(frame, contacts)
        now_s = clock()
        if not begin and now_s - since_s >= task["warm_s"]:
            if task["events"]:
                counting.append(perf(task["events"], "-p", str(os.getpid())))
            begin.update(sample())
        elif begin and now_s - begin["wall_s"] >= task["seconds"]:
            ended.update({} if ended else sample())
            if (told := next(steps) if task["stages"] else {}) is not None:
                counted.update(told)
                service.stop()

    preroll.keep = watched  # type: ignore[method-assign]
    service.run()
    found = _result(begin, ended, done, device.due_ns)
    for process in counting:
        process.send_signal(signal.SIGINT)
        found["events"] = process.communicate()[1]
    return found | counted


def perf(events: Iterable[str], *what: str) -> subprocess.Popen[str]:
    """Let perf count events of a command, or in all threads of a process until it is interrupted."""
    asked = ["perf", "stat", "-x", ",", *(part for event in events for part in ("-e", event)), *what]
    return subprocess.Popen(asked, stderr=subprocess.PIPE, text=True)  # noqa: S603 - as written


def _result(
    begin: dict[str, Any], ended: dict[str, Any], done: list[tuple[int, int, int]], due_ns: list[int]
) -> dict[str, Any]:
    wall_s, frames = ended["wall_s"] - begin["wall_s"], ended["frames"] - begin["frames"]
    counted = done[begin["frames"] : ended["frames"]]
    threads = {
        name: round((count - begin["switches"].get(name, 0)) / wall_s, 2) for name, count in ended["switches"].items()
    }
    split = {stage: [(last - first) * 1e-3 / frames for last, first in zip(taken, begin["stages"][stage], strict=True)]
             for stage, taken in ended["stages"].items()}  # fmt: skip
    frame_us = 1e6 * (ended["cpu_s"] - begin["cpu_s"]) / frames
    wake_us = float(np.median([(received - due_ns[number]) * 1e-3 for number, received, _ in counted]))
    found = {
        "cpu_us_per_s": 1e6 * (ended["cpu_s"] - begin["cpu_s"]) / wall_s,
        "cpu_us_per_frame": frame_us, "counted": frames, "wake_us": wake_us,
        "wakeups_hz": sum(threads.values()), "threads_hz": threads, "frames_hz": frames / wall_s,
        "faults_hz": (ended["faults"] - begin["faults"]) / wall_s,
        "done_us": float(np.median([(at - due_ns[number]) * 1e-3 for number, _, at in counted])),
        "stages": {"wake-up": [wake_us, frame_us - sum(cpu for _, cpu in split.values())], **split},
        "frames": {number: (due_ns[number], received) for number, received, _ in counted},
    }  # fmt: skip
    if begin["energy_uj"] is not None:
        found["energy_w"] = 1e-6 * (ended["energy_uj"] - begin["energy_uj"]) / wall_s
    return found


if __name__ == "__main__":
    print(json.dumps(run(json.loads(sys.argv[1]))))
