"""`make bench`: what a frame costs, beside the bare network in the same process at the same time.

Times of a shared computer mean little by themselves. So every kind of frame takes turns with the bare network in
short rounds, and what is printed beside the times is the median of each round's ratio.
"""

from __future__ import annotations

import os

# ruff: noqa: E402 - one thread, before numpy is imported
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ[_name] = "1"

import platform
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from tests.processes import PATIENCE_S, started
from touchd.client import Subscriber
from touchd.config import Settings
from touchd.event import HealthEvent, TouchEvent
from touchd.frame import Counts, Frame
from touchd.message import Messages
from touchd.model import Model, default_model_path
from touchd.pipeline import Pipeline
from touchd.recording import Recording, write
from touchd.twin.simulate import simulate_scene

ROUNDS = 200
BATCH = 20
PERIOD_NS = 8_000_000
SECONDS = 5.0
"""How long frames go over a real socket."""


class Kind(NamedTuple):
    """Frames of one kind, and the pipeline that they go through."""

    name: str
    pipeline: Pipeline
    counts: list[Counts]
    """Played to and fro."""


class Clocked:
    """Times the calls of a function one by one."""

    def __init__(self) -> None:
        self.times_us: list[NDArray[np.float64]] = []

    def batch(self, calls: list[Callable[[], object]]) -> None:
        """Call each, and keep how long it took."""
        stamps = [time.perf_counter_ns()]
        for call in calls:
            call()
            stamps.append(time.perf_counter_ns())
        self.times_us.append(np.diff(stamps).astype(np.float64) * 1e-3)

    @property
    def all_us(self) -> NDArray[np.float64]:
        return np.concatenate(self.times_us)

    def medians_us(self) -> NDArray[np.float64]:
        """The median of each round."""
        return np.median(self.times_us, axis=1)


def kinds(model: Model) -> list[Kind]:
    """Idle frames, a finger that rests, and one that moves."""
    settings = Settings.model_validate({"baseline": {"absorb_s": 1e6}})
    made = []
    for name, scene in (("idle", "idle"), ("still finger", "hold"), ("moving finger", "circle")):
        recording = simulate_scene(scene, seed=1)
        # Nobody listens to the spectrum.
        pipeline = Pipeline(
            recording.acquisition, model, settings, Messages("bench", 0), wants=lambda topic: topic != "spectrum"
        )
        start, stop = (40, 240) if name == "idle" else (250, 450)
        for i in range(start):
            pipeline.process(Frame(recording.frames[i], i, i * PERIOD_NS, 0))
        made.append(Kind(name, pipeline, list(recording.frames[start:stop])))
    return made


def calls_of(kind: Kind) -> Iterator[Callable[[], object]]:
    """Endless calls of the pipeline with frames of one kind."""
    there_and_back = kind.counts + kind.counts[-2:0:-1]
    number = len(kind.counts) + 1000
    while True:
        for counts in there_and_back:
            frame = Frame(counts, number, number * PERIOD_NS, 0)
            yield lambda frame=frame: kind.pipeline.process(frame)  # type: ignore[misc]  # mypy sees no default
            number += 1


def stages() -> None:
    """Print what each kind of frame costs beside the bare network."""
    model = Model(default_model_path())
    rows = [(kind, calls_of(kind), Clocked()) for kind in kinds(model)]
    network = Clocked()
    before = {kind.name: kind.pipeline.counters.inferred for kind, _, _ in rows}
    for _ in range(ROUNDS):
        network.batch([model.infer] * BATCH)
        for _, calls, clocked in rows:
            clocked.batch([next(calls) for _ in range(BATCH)])
    print(f"\n{'frame -> events':16} {'p50 us':>8} {'p99 us':>8} {'frames/s':>9} {'x network':>10} {'inferred':>9}")
    print(f"{'bare network':16} {_times(network.all_us)} {1:10.2f} {'':>9}")
    for kind, _, clocked in rows:
        ratio = np.median(clocked.medians_us() / network.medians_us())
        inferred = (kind.pipeline.counters.inferred - before[kind.name]) / (ROUNDS * BATCH)
        print(f"{kind.name:16} {_times(clocked.all_us)} {ratio:10.2f} {inferred:9.0%}")
    idle, *touched = (clocked.medians_us() for _, _, clocked in rows)
    for (kind, _, _), times_us in zip(rows[1:], touched, strict=True):
        print(f"an idle frame costs {np.median(idle / times_us):.3f} of one with a {kind.name}")


def _times(times_us: NDArray[np.float64]) -> str:
    p50, p99 = np.percentile(times_us, (50, 99))
    return f"{p50:8.1f} {p99:8.1f} {1e6 / times_us.mean():9.0f}"


def over_the_bus(recording: Recording) -> None:
    """Print how long a touch takes from its frame to a subscriber in another process, at 125 frames a second."""
    with tempfile.TemporaryDirectory(prefix="touchd-bench-") as folder:
        path = Path(folder) / "circle.npz"
        write(path, recording, compress=False)
        address = f"ipc://{folder}/bus"
        options = ("--replay", path, "--loop", "--bind", address, "--await-subscriber", PATIENCE_S)
        to_socket_us: list[float] = []
        to_subscriber_us: list[float] = []
        health: list[HealthEvent] = []
        # A frame of a replay at speed 1 is complete when it is due: at the very time it bears.
        with Subscriber(address, ("touch", "health"), PATIENCE_S) as events, started(*options) as daemon:
            deadline_s: float | None = None
            for event in events:
                now_ns = time.monotonic_ns()
                deadline_s = deadline_s or time.monotonic() + SECONDS
                if isinstance(event, TouchEvent):
                    to_socket_us.append(event.latency_us)
                    to_subscriber_us.append((now_ns - event.t_ns) * 1e-3)
                elif isinstance(event, HealthEvent):
                    health.append(event)
                if time.monotonic() > deadline_s:
                    break
            memory = _memory(daemon)
            cpu_s = _cpu_s(daemon)
            daemon.terminate()
            daemon.wait(PATIENCE_S)
    frames = health[-1].frames
    print(f"\nover ipc:// at 125 frames/s for {SECONDS:g} s: {frames} frames, {health[-1].inferred} inferred, "
          f"{len(to_socket_us)} messages, {events.lost.total()} lost")  # fmt: skip
    print(f"{'':28} {'p50 us':>8} {'p99 us':>8}")
    for name, times_us in (("frame taken in -> socket", to_socket_us), ("frame due -> subscriber", to_subscriber_us)):
        p50, p99 = np.percentile(times_us, (50, 99))
        print(f"{name:28} {p50:8.0f} {p99:8.0f}")
    print(f"daemon: {memory}, {cpu_s:.2f} s of processor time with its start")


def _memory(process: subprocess.Popen[str]) -> str:
    """What a process holds in memory, now and at most."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    sizes = dict(re.findall(r"(VmHWM|VmRSS):\s+(\d+) kB", status))
    return f"{int(sizes['VmRSS']) / 1024:.0f} MiB resident, {int(sizes['VmHWM']) / 1024:.0f} MiB at most"


def _cpu_s(process: subprocess.Popen[str]) -> float:
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def machine() -> str:
    """The processor, and the versions that matter."""
    found = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    cpu = found[1] if found else platform.machine()
    load = os.getloadavg()[0]
    return (
        f"{cpu}, {os.cpu_count()} cores, load {load:.2f}\n"
        f"python {platform.python_version()}, numpy {np.__version__}, onnxruntime {onnxruntime.__version__}"
    )


def main() -> None:
    """Measure everything, in about ten seconds."""
    print(machine())
    stages()
    over_the_bus(simulate_scene("circle", seed=1))


if __name__ == "__main__":
    main()
