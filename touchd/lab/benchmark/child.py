"""`python -m touchd.lab.benchmark.child`: the daemon in its own process, with the usual composition plus a clock.

It reads what to do as JSON on standard input, and writes what it measured as a file of arrays.
"""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from touchd.config.schema import LogSettings, Settings
from touchd.event import Contact
from touchd.frame import Frame
from touchd.lab.benchmark.boundnetwork import BoundNetwork
from touchd.lab.benchmark.loop import BURST, Loop, LoopSource
from touchd.outcome import Counters
from touchd.service import realtime
from touchd.service.daemon import load_model, make_service
from touchd.service.log import configure
from touchd.service.preroll import PreRoll
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.recorder import describe

WARM_UP_RUNS, BARE_RUNS = 50, 400


class Task(BaseModel):
    """Parameters of a run."""

    model_config = ConfigDict(frozen=True)

    loop: Path
    rate_hz: float | None
    """None for full speed."""
    seconds: float
    bare: Path
    output: Path
    settings: dict[str, Any]
    cpus: tuple[int, ...]
    """Processors to run on; empty leaves it to the kernel."""
    patience_s: float


class Clocked:
    """Wraps the pre-roll, which receives each frame last, and records times."""

    def __init__(self, preroll: PreRoll, most_frames: int) -> None:
        self._preroll = preroll
        self._keep = preroll.keep
        # Filled with ones, so that the kernel maps the memory before the run.
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
        self._keep(frame, contacts)

    def poll(self) -> None:
        """Forward the call for a time-out without a frame."""
        self._preroll.poll()

    def close(self) -> None:
        """Close the pre-roll."""
        self._preroll.close()


class Pauses:
    """Measures the pauses of the garbage collector."""

    def __init__(self) -> None:
        self.us: list[float] = []
        self._since_ns = 0

    def __call__(self, phase: str, _info: dict[str, int]) -> None:
        """Record a pause; a callback of `gc`."""
        if phase == "start":
            self._since_ns = time.perf_counter_ns()
        else:
            self.us.append((time.perf_counter_ns() - self._since_ns) * 1e-3)


def run(task: Task) -> None:
    """Run the daemon through a scene and write the measurements."""
    # At full speed bare runs alternate with frames; at a steady rate their memory would distort the result.
    between = _bare(task.bare) if task.rate_hz is None else None
    bare_us: list[float] = []
    at_start: dict[str, float] = {}
    pauses = Pauses()
    bare_cpu_s = 0.0

    def burst() -> None:
        nonlocal bare_cpu_s
        before_s = time.thread_time()
        assert between is not None  # only a source at full speed calls this
        bare_us.extend(between(BURST))
        bare_cpu_s += time.thread_time() - before_s

    def begun() -> None:
        gc.callbacks.append(pauses)
        at_start.update(_counted(service.pipeline.counters), cpu_s=time.process_time(), wall_s=time.monotonic())

    settings = Settings.model_validate(task.settings)
    configure(LogSettings(level="error"))
    if task.cpus:
        os.sched_setaffinity(0, task.cpus)
    model = load_model(settings)
    loop = Loop.load(task.loop)
    rate_hz = task.rate_hz or float("inf")
    source = LoopSource(loop, rate_hz, task.seconds, burst, begun)
    with realtime.giving_way() if task.rate_hz is None else nullcontext():
        bus = ZeromqSink(settings.bus)
    most_frames = loop.lead + round(task.seconds * min(rate_hz, 200_000)) + 1
    real_hz = task.rate_hz or 125.0
    meta = describe(source.acquisition, model.description.plate, real_hz, source="benchmark", device=None)
    preroll = PreRoll(source.acquisition, real_hz, lambda: meta, settings.preroll)
    clocked = Clocked(preroll, most_frames)
    service = make_service(source, [bus], settings, model, preroll=clocked)
    realtime.freeze()
    ready_ns = time.monotonic_ns()
    bus.wait_for_subscriber(task.patience_s)
    service.run()
    cpu_s, wall_s = time.process_time() - at_start["cpu_s"], time.monotonic() - at_start["wall_s"]
    if pauses in gc.callbacks:
        gc.callbacks.remove(pauses)
    rss = _rss_bytes()
    clocked.close()
    if between is None:
        bare_us = _bare(task.bare)(BARE_RUNS)
    # Subtract the counts of the lead-in.
    counts = {name: count - at_start.get(name, 0) for name, count in _counted(service.pipeline.counters).items()}
    taken = slice(loop.lead, clocked.count)
    np.savez(
        task.output, lead=loop.lead, received_ns=clocked.received_ns[taken], done_ns=clocked.done_ns[taken],
        bare_us=bare_us, pauses_us=pauses.us, cpu_s=cpu_s - bare_cpu_s, wall_s=wall_s - source.apart_s, rss=rss,
        ready_ns=ready_ns, frames=counts.pop("frames"), lost=counts.pop("lost"), inferred=counts.pop("inferred"),
        reasons=list(counts), skipped=list(counts.values()),
    )  # fmt: skip


def _counted(counters: Counters) -> dict[str, float]:
    """Return the counts of frames, lost and inferred, and of skipped frames by reason."""
    own = {"frames": counters.frames, "lost": counters.lost, "inferred": counters.inferred}
    return {**own, **counters.skipped}


def _bare(path: Path) -> Any:
    """Return a function that runs the bare network `count` times and returns the times, us."""
    runner = BoundNetwork(path)
    runner.inputs[...] = np.random.default_rng(0).standard_normal(runner.inputs.shape)
    for _ in range(WARM_UP_RUNS):
        runner()

    def timed(count: int) -> list[float]:
        times_us = []
        for _ in range(count):
            begun_ns = time.perf_counter_ns()
            runner()
            times_us.append((time.perf_counter_ns() - begun_ns) * 1e-3)
        return times_us

    return timed


def _rss_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    run(Task.model_validate_json(sys.stdin.read()))
