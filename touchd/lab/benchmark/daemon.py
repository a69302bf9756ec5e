"""Measure the daemon end to end: it runs in its own process, and this process subscribes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from touchd.client import Subscriber
from touchd.errors import BusError, JobError
from touchd.event import Event, HealthEvent, TouchEvent
from touchd.lab.benchmark.child import PATIENCE_S, Task, main
from touchd.lab.benchmark.loop import Loop
from touchd.lab.benchmark.results import DaemonResult, Day, percentiles, rounded
from touchd.lab.benchmark.stopwatch import spread, undisturbed

DAY = {"idle": 0.98, "still": 0.01, "moving": 0.01}
"""Share of each scene in a typical day."""
FOREVER_S = 86_400.0
ENDLESS = 100_000
SPAWN = multiprocessing.get_context("spawn")


def measure(
    scene: str, loop: Loop, rate_hz: float | None, seconds: float, *, model: Path, bare: Path, folder: Path,
    apart: bool = False, awake: bool = True,
) -> DaemonResult:  # fmt: skip
    """Run the daemon through one scene at one rate, None for full speed; `bare` is the bare network.

    With `apart` the subscriber has its own processor at a steady rate too; at full speed it always has. With `awake`
    the processors are kept awake while the plate is touched, as is the default at high rates. The sockets are in
    `folder`.

    Raises
    ------
    JobError
        The daemon fails.
    """
    address = f"ipc://{folder}/bus"
    # At full speed the subscriber may fall behind; a large high-water mark prevents losses.
    bus = {"bind": [address]} if rate_hz is not None else {"bind": [address], "high_water_mark": ENDLESS}
    settings: dict[str, Any] = {
        "bus": bus, "model": {"path": str(model)}, "baseline": {"absorb_s": FOREVER_S},
        "preroll": {"folder": str(folder)}, "realtime": {} if awake else {"awake_from_hz": 0},
    }  # fmt: skip
    task = Task(scene, loop, rate_hz, seconds, bare, settings, daemon_cpus(), time.monotonic_ns())
    with (
        subscribing(apart=apart or rate_hz is None),
        Subscriber(address, ("touch", "health"), PATIENCE_S, max_age_s=None) as events,
        _running(task) as connection,
    ):
        arrivals = dict(_arrivals(events, connection))
        lost = events.lost.total()
        if not connection.poll(PATIENCE_S):
            raise JobError("the daemon did not end", "benchmark", "run it alone, and see its log")
        found: tuple[DaemonResult, dict[int, int]] | str = connection.recv()
    if isinstance(found, str):
        raise JobError(f"the daemon failed: {found}", "benchmark", "see the cause")
    result, received_ns = found
    more: dict[str, Any] = {"messages": len(arrivals), "lost": result.lost + lost}
    arrived = [(arrivals[frame] - at_ns) * 1e-3 for frame, at_ns in received_ns.items() if frame in arrivals]
    if rate_hz is not None and arrived:
        more |= {"to": "subscriber", **percentiles(spread(arrived))}
    elif arrivals:
        more["to"] = "socket"
    return result.model_copy(update=more)


def day(cells: Iterable[DaemonResult]) -> Day | None:
    """Return the cost of a typical day, from the cells at 125 frames/s."""
    share = {cell.scene: cell.cpu_share for cell in cells if cell.rate_hz == 125}
    if not DAY.keys() <= share.keys():
        return None
    mean = sum(part * share[scene] for scene, part in DAY.items())
    return Day(**DAY, cpu_s_per_hour=rounded(3600 * mean, 3))


def daemon_cpus() -> tuple[int, ...]:
    """Return the processor of the daemon and its threads; empty with a single processor."""
    cpus = sorted(os.sched_getaffinity(0))
    # The last one, because interrupts mostly go to the first.
    return (cpus[-1],) if len(cpus) > 1 else ()


def subscribing(*, apart: bool) -> AbstractContextManager[None]:
    """Pin this thread, and those it starts, to the daemon's processor, or off it if `apart`.

    The garbage collector ignores the benchmark's objects meanwhile, since a subscriber would not have them.
    """
    every = os.sched_getaffinity(0)
    own = set(daemon_cpus()) or every
    return undisturbed((every - own or every) if apart else own)


def start(process: BaseProcess) -> None:
    """Start a process that Ctrl-C does not reach, which is for its parent: it would end with a traceback."""
    resource_tracker.ensure_running()  # on its first start it unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _running(task: Task) -> Iterator[Connection]:
    """Run the daemon's process; it is gone afterwards."""
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=main, args=(task, theirs), daemon=True)
    start(process)
    theirs.close()  # so that the end of the process ends the pipe
    try:
        yield ours
    except EOFError:
        raise JobError("the daemon's process ended without a result", "benchmark", "see its log") from None
    finally:
        process.join(1.0)
        process.kill()
        ours.close()


def _arrivals(events: Subscriber[Event], connection: Connection) -> Iterator[tuple[int, int]]:
    """Yield each touch message's frame and arrival time, until the daemon stops."""
    while True:
        try:
            event = events.receive(0.5)
        except BusError:
            if connection.poll():
                return
            continue
        now_ns = time.monotonic_ns()
        if isinstance(event, TouchEvent):
            yield event.frame, now_ns
        elif isinstance(event, HealthEvent) and event.state == "stopping":
            return
