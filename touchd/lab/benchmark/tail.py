"""Latency tail of a moving finger, beside its floors and in other circumstances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from touchd.lab.benchmark import bus
from touchd.lab.benchmark.placement import daemon_cpus, subscribing
from touchd.lab.benchmark.results import BUS_RATE_HZ, BareTimes, DaemonResult, Otherwise, rounded
from touchd.lab.benchmark.stopwatch import Spread, held_up, middle
from touchd.service.cpu_latency import permitted

TAIL = "moving", BUS_RATE_HZ
"""Scene and rate whose tail is measured."""
TURNS = 3
"""Turns, of which the median tail counts: a shared computer may delay a process longer than anything measured."""


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

    Parameters
    ----------
    cell : callable
        Runs the cell, with the options `apart` and `awake` of `daemon.measure`.
    seconds : float
        Duration of each other measurement.
    folder : Path
        Folder for the sockets.
    """
    here, floors, late, apart, floors_apart, asleep = [], [], [], [], [], []
    for _ in range(TURNS):
        with subscribing(apart=False):
            late.append(held_up(BUS_RATE_HZ, seconds))
        floors.append(bus.measure(BUS_RATE_HZ, seconds, folder))
        here.append(cell())
        if daemon_cpus():
            floors_apart.append(bus.measure(BUS_RATE_HZ, seconds, folder, apart=True))
            apart.append(cell(apart=True))
        if permitted():
            asleep.append(cell(awake=False))
    return Tails(
        cell=middle(here, lambda found: found.p999_us), bus_us=_times(floors), held_up_us=_times(late),
        apart=Otherwise(daemon_us=_to_subscriber(apart), bus_us=_times(floors_apart)) if apart else None,
        asleep=Otherwise(daemon_us=_to_subscriber(asleep)) if asleep else None,
    )  # fmt: skip


def _to_subscriber(found: list[DaemonResult]) -> BareTimes:
    one = middle(found, lambda each: each.p999_us)
    return BareTimes(p50=one.p50_us, p99=one.p99_us, p999=one.p999_us)


def _times(found: list[Spread]) -> BareTimes:
    one = middle(found, lambda each: each.p999)
    return BareTimes(p50=rounded(one.p50), p99=rounded(one.p99), p999=rounded(one.p999))
