"""The latency of a moving finger beside its floors: the bus alone, and a program that polls the clock."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import zmq

from touchd.errors import JobError
from touchd.lab.benchmark.child import BURN_IN_S
from touchd.lab.benchmark.daemon import SPAWN, daemon_cpus, start, subscribing
from touchd.lab.benchmark.results import BUS_RATE_HZ, BareTimes, DaemonResult, Otherwise
from touchd.lab.benchmark.stopwatch import Spread, held_up, middle, spread
from touchd.service.realtime import Awake, permitted

TAIL = "moving", BUS_RATE_HZ
"""Scene and rate whose tail is measured."""
TURNS = 3
"""Turns, of which the median tail counts: a shared computer may delay a process longer than anything measured."""
BODY_BYTES = 330
"""Size of a touch message with one contact."""
PATIENCE_MS = 10_000


@dataclass(frozen=True, slots=True)
class Tails:
    """Latency of the daemon, of the bus alone, and of a program that polls the clock."""

    cell: DaemonResult
    bus_us: BareTimes
    held_up_us: BareTimes
    apart: Otherwise | None
    asleep: Otherwise | None


def measure(cell: Callable[..., DaemonResult], seconds: float, folder: Path) -> Tails:
    """Measure a cell, its floors, and the cell in other circumstances, in turns.

    `cell` runs the cell, with the options `apart` and `awake` of `daemon.measure`; each other measurement takes
    `seconds`; the sockets are in `folder`.
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
    return Tails(
        cell=middle(here, lambda found: found.p999_us), bus_us=_middle(floors), held_up_us=_middle(late),
        apart=Otherwise(daemon_us=_to_subscriber(apart), bus_us=_middle(floors_apart)) if apart else None,
        asleep=Otherwise(daemon_us=_to_subscriber(asleep)) if asleep else None,
    )  # fmt: skip


def measure_bus(rate_hz: float, seconds: float, folder: Path, *, apart: bool = False) -> Spread:
    """Return the latency of messages between two processes, us: on one processor, or on two if `apart`.

    One process sends the time at a steady rate, this one receives it. The delay is due to ZeroMQ, kernel and computer.

    Raises
    ------
    JobError
        No message arrived.
    """
    address = f"ipc://{folder}/bare-bus"
    took_us: list[float] = []
    cpus = daemon_cpus()
    with subscribing(apart=apart), zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.RCVTIMEO, PATIENCE_MS)
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


def _to_subscriber(found: list[DaemonResult]) -> BareTimes:
    one = middle(found, lambda each: each.p999_us)
    return BareTimes(p50=one.p50_us, p99=one.p99_us, p999=one.p999_us)


def _middle(found: list[Spread]) -> BareTimes:
    return BareTimes.of(middle(found, lambda each: each.p999))
