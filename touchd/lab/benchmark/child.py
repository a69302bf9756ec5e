"""The daemon in a process of its own, with the usual composition plus a clock."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Sequence
from math import inf
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from touchd.config.schema import LogSettings, Settings
from touchd.errors import JobError
from touchd.event import Contact
from touchd.frame import Frame
from touchd.lab.benchmark.loop import BURST, BareNetwork, Loop, LoopSource
from touchd.lab.benchmark.stopwatch import Stopwatch, percentiles, spread
from touchd.outcome import Counters
from touchd.service import realtime
from touchd.service.daemon import load_model, make_pipeline
from touchd.service.log import configure
from touchd.service.loop import Service
from touchd.service.preroll import PreRoll
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.recorder import describe

WARM_UP_RUNS, BARE_RUNS = 50, 400
PATIENCE_S = 30.0
BURN_IN_S = 0.3
"""Frames of this time at the start are discarded."""
Found = tuple[dict[str, Any], dict[int, int]]
"""Fields of a `DaemonResult`, timed to the decision; and when each counted frame was complete, ns, by its number."""


def main(connection: Connection, *arguments: Any) -> None:
    """Send what `run` found, or the text of the error."""
    try:
        connection.send(run(*arguments))
    except Exception as error:
        connection.send(str(error) or repr(error))


def run(
    loop: Loop, rate_hz: float | None, seconds: float, bare_path: Path, chosen: dict[str, Any], cpus: tuple[int, ...],
    begun_ns: int,
) -> Found:  # fmt: skip
    """Run the daemon through a scene, with some settings on some processors; without any, the kernel chooses.

    `rate_hz` is None at full speed; `begun_ns` is when the process was started.
    """
    full_speed = rate_hz is None
    # At full speed bare runs alternate with frames; at a steady rate their memory would distort the result.
    bare = _warm(bare_path) if full_speed else None
    watch = Stopwatch()
    collector_ns: list[int] = []
    """When each garbage collection began and ended, in turns."""
    at_start: dict[str, float] = {}
    bare_cpu_s = 0.0

    def collecting(_phase: str, _info: dict[str, int]) -> None:
        collector_ns.append(time.perf_counter_ns())

    def burst() -> None:
        nonlocal bare_cpu_s
        before_s = time.thread_time()
        assert bare is not None  # only a source at full speed calls this
        watch.time(bare, BURST)
        bare_cpu_s += time.thread_time() - before_s

    def begun() -> None:
        gc.callbacks.append(collecting)
        at_start.update(_counted(service.pipeline.counters), cpu_s=time.process_time(), wall_s=time.monotonic())

    settings = Settings.model_validate(chosen)
    configure(LogSettings(level="error"))
    if cpus:
        os.sched_setaffinity(0, cpus)
    model = load_model(settings)
    source = LoopSource(loop, rate_hz or inf, seconds, burst, begun)
    bus = ZeromqSink(settings.bus)
    meta = describe(source.acquisition, model.description.plate, rate_hz or 125.0, source="benchmark", device=None)
    preroll = PreRoll(rate_hz or 125.0, lambda: meta, settings.preroll)
    # Filled, so that the kernel maps the memory before the run.
    received_ns, done_ns = np.ones((2, source.lead + round(seconds * (rate_hz or 200_000)) + 1), np.int64)
    count, keep = 0, preroll.keep

    def clocked(frame: Frame, contacts: Sequence[Contact]) -> None:
        """Note when the frame was complete and when its messages were handed over: the pre-roll has each frame last."""
        nonlocal count
        now_ns = time.monotonic_ns()
        i = frame.sequence
        if i < len(done_ns):
            received_ns[i], done_ns[i] = frame.received_ns, now_ns
            count = i + 1
        keep(frame, contacts)

    preroll.keep = clocked  # type: ignore[method-assign]  # its last stage, timed from outside
    service = Service(source, [bus], settings, make_pipeline(source, settings, model), preroll=preroll)
    realtime.freeze()
    ready_ns = time.monotonic_ns()
    bus.wait_for_subscriber(PATIENCE_S)
    service.run()
    cpu_s, wall_s = time.process_time() - at_start["cpu_s"], time.monotonic() - at_start["wall_s"]
    gc.callbacks.remove(collecting)
    rss_bytes = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    preroll.close()
    if bare is None:
        watch.time(_warm(bare_path), BARE_RUNS)
    first_ns = received_ns[source.lead] + BURN_IN_S * 1e9
    counted = source.lead + np.flatnonzero(received_ns[source.lead : count] >= first_ns)
    if not len(counted):
        raise JobError("the daemon took no frames", "benchmark", "allow it more time")
    handed = spread((done_ns[counted] - received_ns[counted]) * 1e-3)
    pauses_us = np.diff(collector_ns)[::2] * 1e-3
    # Without the lead-in, and without the bare runs.
    frames, cpu_s, wall_s = count - source.lead, cpu_s - bare_cpu_s, wall_s - source.apart_ns * 1e-9
    counts = {name: count - at_start.get(name, 0) for name, count in _counted(service.pipeline.counters).items()}
    taken, lost, inferred = (counts.pop(name) for name in ("frames", "lost", "inferred"))
    found = percentiles(handed) | {
        "to": "decision", "frames": len(counted),
        "handed_p50_us": handed.p50, "handed_p99_us": handed.p99, "handed_p999_us": handed.p999,
        "ratio": handed.p50 / float(np.median(watch.times_us)), "frames_per_s": frames / wall_s,
        "frames_per_cpu_s": frames / cpu_s, "cpu_share": cpu_s / wall_s, "rss_mb": rss_bytes / 2**20,
        "gc_pauses": len(pauses_us), "gc_longest_us": float(max(pauses_us, default=0.0)), "lost": int(lost),
        "skipped": {why: count / taken for why, count in counts.items() if count},
        "inferred": inferred / taken, "start_s": (ready_ns - begun_ns) * 1e-9,
    }  # fmt: skip
    return found, dict(zip(counted.tolist(), received_ns[counted].tolist(), strict=True))


def _counted(counters: Counters) -> dict[str, float]:
    own = {"frames": counters.frames, "lost": counters.lost, "inferred": counters.inferred}
    return {**own, **counters.skipped}


def _warm(path: Path) -> BareNetwork:
    bare = BareNetwork(path)
    for _ in range(WARM_UP_RUNS):
        bare()
    return bare
