"""The daemon in a process of its own, with the usual composition plus a clock."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import LogSettings, Settings
from touchd.event import Contact
from touchd.frame import Frame
from touchd.lab.benchmark.bare import BareNetwork
from touchd.lab.benchmark.loop import BURST, Loop, LoopSource
from touchd.lab.benchmark.stopwatch import Stopwatch
from touchd.outcome import Counters
from touchd.service import realtime
from touchd.service.daemon import load_model, make_service
from touchd.service.log import configure
from touchd.service.preroll import PreRoll
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.recorder import describe

WARM_UP_RUNS, BARE_RUNS = 50, 400


@dataclass(frozen=True, slots=True)
class Task:
    """Parameters of a run."""

    loop: Loop
    rate_hz: float | None
    """None for full speed."""
    seconds: float
    bare: Path
    settings: dict[str, Any]
    cpus: tuple[int, ...]
    """Processors to run on; empty leaves it to the kernel."""
    patience_s: float


@dataclass(frozen=True, slots=True)
class Measured:
    """What a run took, without the lead-in."""

    lead: int
    received_ns: NDArray[np.int64]
    done_ns: NDArray[np.int64]
    """Time when the messages of each frame were handed over."""
    bare_us: NDArray[np.float64]
    pauses_us: list[float]
    cpu_s: float
    wall_s: float
    rss_bytes: int
    ready_ns: int
    counts: dict[str, float]
    """Frames in all, `lost`, `inferred`, and skipped by reason."""


class Clocked(PreRoll):
    """The pre-roll, which receives each frame last; it also records times."""

    def start_clock(self, most_frames: int) -> None:
        """Reserve memory, filled with ones so that the kernel maps it before the run."""
        self.received_ns = np.ones(most_frames, np.int64)
        self.done_ns = np.ones(most_frames, np.int64)
        self.count = 0

    def keep(self, frame: Frame, contacts: Sequence[Contact]) -> None:
        """Store when the frame was complete and when its messages were handed over, then keep the frame."""
        now_ns = time.monotonic_ns()
        i = frame.sequence
        if i < len(self.done_ns):
            self.received_ns[i], self.done_ns[i] = frame.received_ns, now_ns
            self.count = i + 1
        super().keep(frame, contacts)


class Pauses:
    """Measures the pauses of the garbage collector, as a callback of `gc`."""

    def __init__(self) -> None:
        self.us: list[float] = []
        self._since_ns = 0

    def __call__(self, phase: str, _info: dict[str, int]) -> None:
        """Record a pause."""
        if phase == "start":
            self._since_ns = time.perf_counter_ns()
        else:
            self.us.append((time.perf_counter_ns() - self._since_ns) * 1e-3)


def main(task: Task, connection: Connection) -> None:
    """Send what was measured, or the text of the error."""
    try:
        connection.send(run(task))
    except Exception as error:
        connection.send(str(error) or repr(error))


def run(task: Task) -> Measured:
    """Run the daemon through a scene."""
    full_speed = task.rate_hz is None
    # At full speed bare runs alternate with frames; at a steady rate their memory would distort the result.
    bare = _warm(task.bare) if full_speed else None
    watch, pauses = Stopwatch(), Pauses()
    at_start: dict[str, float] = {}
    bare_cpu_s = 0.0

    def burst() -> None:
        nonlocal bare_cpu_s
        before_s = time.thread_time()
        assert bare is not None  # only a source at full speed calls this
        watch.time(bare, BURST)
        bare_cpu_s += time.thread_time() - before_s

    def begun() -> None:
        gc.callbacks.append(pauses)
        at_start.update(_counted(service.pipeline.counters), cpu_s=time.process_time(), wall_s=time.monotonic())

    settings = Settings.model_validate(task.settings)
    configure(LogSettings(level="error"))
    if task.cpus:
        os.sched_setaffinity(0, task.cpus)
    model = load_model(settings)
    source = LoopSource(task.loop, task.rate_hz or float("inf"), task.seconds, burst, begun)
    with realtime.giving_way() if full_speed else nullcontext():
        bus = ZeromqSink(settings.bus)
    rate_hz = task.rate_hz or 125.0
    meta = describe(source.acquisition, model.description.plate, rate_hz, source="benchmark", device=None)
    preroll = Clocked(source.acquisition, rate_hz, lambda: meta, settings.preroll)
    preroll.start_clock(source.lead + round(task.seconds * (task.rate_hz or 200_000)) + 1)
    service = make_service(source, [bus], settings, model, preroll=preroll)
    realtime.freeze()
    ready_ns = time.monotonic_ns()
    bus.wait_for_subscriber(task.patience_s)
    service.run()
    cpu_s, wall_s = time.process_time() - at_start["cpu_s"], time.monotonic() - at_start["wall_s"]
    gc.callbacks.remove(pauses)
    rss_bytes = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    preroll.close()
    if bare is None:
        watch.time(_warm(task.bare), BARE_RUNS)
    taken = slice(source.lead, preroll.count)
    return Measured(
        source.lead, preroll.received_ns[taken], preroll.done_ns[taken], watch.times_us, pauses.us,
        cpu_s - bare_cpu_s, wall_s - source.apart_ns * 1e-9, rss_bytes, ready_ns,
        {name: count - at_start.get(name, 0) for name, count in _counted(service.pipeline.counters).items()},
    )  # fmt: skip


def _counted(counters: Counters) -> dict[str, float]:
    own = {"frames": counters.frames, "lost": counters.lost, "inferred": counters.inferred}
    return {**own, **counters.skipped}


def _warm(path: Path) -> BareNetwork:
    bare = BareNetwork(path)
    for _ in range(WARM_UP_RUNS):
        bare()
    return bare
