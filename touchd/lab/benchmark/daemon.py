"""Measure the daemon end to end, in a process of its own, and beside it the floors of its latency.

The floors are the bus alone, and a program that polls the clock.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import zmq

from touchd.client import Subscriber
from touchd.errors import BusError, JobError
from touchd.event import Event, HealthEvent, TouchEvent
from touchd.lab.benchmark.child import BURN_IN_S, PATIENCE_S, Found, main
from touchd.lab.benchmark.loop import Loop
from touchd.lab.benchmark.results import BUS_RATE_HZ, BareTimes, DaemonResult, Day, Otherwise
from touchd.lab.benchmark.stopwatch import Spread, held_up, middle, percentiles, spread, undisturbed
from touchd.service.realtime import Awake, permitted

DAY = {"idle": 0.98, "still": 0.01, "moving": 0.01}
"""Share of each scene in a typical day."""
FOREVER_S = 86_400.0
ENDLESS = 100_000
SPAWN = multiprocessing.get_context("spawn")
TAIL = "moving", BUS_RATE_HZ
"""Scene and rate whose tail is measured."""
TURNS = 3
"""Turns, of which the median tail counts: a shared computer may delay a process longer than anything measured."""
BODY_BYTES = 330
"""Size of a touch message with one contact."""


def measure(
    scene: str, loop: Loop, rate_hz: float | None, seconds: float, *, model: Path, bare: Path, folder: Path,
    apart: bool = False, awake: bool = True,
) -> DaemonResult:  # fmt: skip
    """Run the daemon through one scene at one rate, None for full speed; `bare` is the bare network.

    With `apart` the subscriber has its own processor at a steady rate too; at full speed it always has. With `awake`
    the processors are kept awake while the plate is touched, as is the default at high rates. The sockets are in
    `folder`. Raises JobError if the daemon fails.
    """
    address = f"ipc://{folder}/bus"
    # At full speed the subscriber may fall behind; a large high-water mark prevents losses.
    bus = {"bind": [address]} if rate_hz is not None else {"bind": [address], "high_water_mark": ENDLESS}
    settings: dict[str, Any] = {
        "bus": bus, "model": {"path": str(model)}, "baseline": {"absorb_s": FOREVER_S},
        "preroll": {"folder": str(folder)}, "realtime": {} if awake else {"awake_from_hz": 0},
    }  # fmt: skip
    arguments = loop, rate_hz, seconds, bare, settings, daemon_cpus(), time.monotonic_ns()
    with (
        subscribing(apart=apart or rate_hz is None),
        Subscriber(address, ("touch", "health"), PATIENCE_S, max_age_s=None) as events,
        _running(*arguments) as connection,
    ):
        arrivals = dict(_arrivals(events, connection))
        lost = events.lost.total()
        if not connection.poll(PATIENCE_S):
            raise JobError("the daemon did not end", "benchmark", "run it alone, and see its log")
        found: Found | str = connection.recv()
    if isinstance(found, str):
        raise JobError(f"the daemon failed: {found}", "benchmark", "see the cause")
    result, received_ns = found
    arrived = [(arrivals[frame] - at_ns) * 1e-3 for frame, at_ns in received_ns.items() if frame in arrivals]
    if rate_hz is not None and arrived:
        result |= {"to": "subscriber", **percentiles(spread(arrived))}
    elif arrivals:
        result["to"] = "socket"
    result["lost"] += lost
    return DaemonResult(scene=scene, rate_hz=rate_hz, messages=len(arrivals), **result)


def day(cells: Iterable[DaemonResult]) -> Day | None:
    """Return the cost of a typical day, from the cells at 125 frames/s."""
    share = {cell.scene: cell.cpu_share for cell in cells if cell.rate_hz == 125}
    if not DAY.keys() <= share.keys():
        return None
    return Day(**DAY, cpu_s_per_hour=3600 * sum(part * share[scene] for scene, part in DAY.items()))


def tails(cell: Callable[..., DaemonResult], seconds: float, folder: Path) -> tuple[DaemonResult, dict[str, Any]]:
    """Measure a cell and, in turns with it, what a `Run` has beside it: its floors, and other circumstances.

    `cell` runs the cell, with the options `apart` and `awake` of `measure`; each other measurement takes `seconds`; the
    sockets are in `folder`.
    """
    here, floors, late, apart, floors_apart, asleep = [], [], [], [], [], []
    for _ in range(TURNS):
        with subscribing(apart=False):
            late.append(held_up(BUS_RATE_HZ, seconds))
        floors.append(measure_bus(BUS_RATE_HZ, seconds, folder))
        here.append(cell())
        if daemon_cpus():
            floors_apart.append(measure_bus(BUS_RATE_HZ, seconds, folder, apart=True))
            apart.append(cell(apart=True))
        if permitted():
            asleep.append(cell(awake=False))
    beside: dict[str, Any] = {"bus_us": _median(floors), "held_up_us": _median(late)}
    if apart:
        beside["apart"] = Otherwise(daemon_us=_to_subscriber(apart), bus_us=_median(floors_apart))
    if asleep:
        beside["asleep"] = Otherwise(daemon_us=_to_subscriber(asleep))
    return middle(here, lambda found: found.p999_us), beside


def _to_subscriber(found: list[DaemonResult]) -> BareTimes:
    one = middle(found, lambda each: each.p999_us)
    return BareTimes(p50=one.p50_us, p99=one.p99_us, p999=one.p999_us)


def _median(found: list[Spread]) -> BareTimes:
    one = middle(found, lambda each: each.p999)
    return BareTimes(p50=one.p50, p99=one.p99, p999=one.p999)


def measure_bus(rate_hz: float, seconds: float, folder: Path, *, apart: bool = False) -> Spread:
    """Return the latency of messages between two processes, us: on one processor, or on two if `apart`.

    One process sends the time at a steady rate, this one receives it. The delay is due to ZeroMQ, kernel and computer.
    Raises JobError if no message arrived.
    """
    address, cpus = f"ipc://{folder}/bare-bus", daemon_cpus()
    took_us: list[float] = []
    with subscribing(apart=apart), zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.RCVTIMEO, 10_000)
        socket.connect(address)
        socket.subscribe(b"touch")
        process = SPAWN.Process(target=_send, args=(address, rate_hz, seconds, cpus), daemon=True)
        start(process)
        try:
            while body := socket.recv_multipart()[1]:
                took_us.append((time.monotonic_ns() - int.from_bytes(body[:8], "little")) * 1e-3)
        except zmq.Again:
            process.kill()
        process.join()
    counted = took_us[round(BURN_IN_S * rate_hz) :]
    if not counted:
        raise JobError("no message arrived over the bare bus", "benchmark", "allow it more time")
    return spread(counted)


def _send(address: str, rate_hz: float, seconds: float, cpus: tuple[int, ...]) -> None:
    """Send after the first subscription; an empty message ends the run. Processors are kept awake as by the daemon."""
    if cpus:
        os.sched_setaffinity(0, cpus)
    if permitted():
        Awake(rate_hz).hold()
    with zmq.Context() as context, context.socket(zmq.XPUB) as socket:
        socket.bind(address)
        socket.recv()
        padding, period_ns = bytes(BODY_BYTES - 8), 1e9 / rate_hz
        start_ns = time.monotonic_ns()
        for i in range(round(rate_hz * seconds)):
            due_ns = start_ns + round(i * period_ns)
            while (now_ns := time.monotonic_ns()) < due_ns:
                time.sleep((due_ns - now_ns) * 1e-9)
            socket.send_multipart([b"touch", now_ns.to_bytes(8, "little") + padding])
        socket.send_multipart([b"touch", b""])


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
def _running(*arguments: Any) -> Iterator[Connection]:
    """Run the daemon's process with the arguments of `run`; it is gone afterwards."""
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=main, args=(theirs, *arguments), daemon=True)
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
