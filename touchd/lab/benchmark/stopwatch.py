"""Time single calls and summarise the times."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Found = TypeVar("_Found")
BURN_IN = 2
"""Batches discarded at the start, while caches, branch predictors and clock rates settle."""
FLOOR_CALLS = 60


class Spread(NamedTuple):
    """Percentiles of times, us."""

    p50: float
    p99: float
    p999: float
    most: float


def percentiles(times: Spread) -> dict[str, float]:
    """Return the fields `p50_us` to `max_us` of a result."""
    return dict(zip(("p50_us", "p99_us", "p999_us", "max_us"), times, strict=True))


def spread(times_us: ArrayLike) -> Spread:
    """Return median, 99th and 99.9th percentile and maximum of times (n,)."""
    return Spread(*np.percentile(np.asarray(times_us, float), (50, 99, 99.9, 100)).tolist())


def held_up(rate_hz: float, seconds: float, clock: Callable[[], int] = time.monotonic_ns) -> Spread:
    """Return how late a program that only polls the clock sees each period's end, us.

    This is the least delay of any program on this processor: the computer, or the host of a virtual one, causes it.
    """
    period_ns, late_us = 1e9 / rate_hz, []
    start_ns = clock()
    for i in range(round(rate_hz * seconds)):
        due_ns = start_ns + round((i + 1) * period_ns)
        while (now_ns := clock()) < due_ns:
            pass
        late_us.append((now_ns - due_ns) * 1e-3)
    return spread(late_us)


def middle(found: list[_Found], key: Callable[[_Found], float]) -> _Found:
    """Return the result with the median key."""
    return sorted(found, key=key)[len(found) // 2]


class Stopwatch:
    """Collects the times of calls, batch by batch."""

    def __init__(self) -> None:
        self.batches_us: list[NDArray[np.float64]] = []

    def add(self, times_ns: list[int]) -> None:
        """Add the times of one batch."""
        self.batches_us.append(np.array(times_ns, float) * 1e-3)

    def time(self, call: Callable[[], object], count: int) -> None:
        """Time each call of a batch."""
        clock, times_ns = time.perf_counter_ns, []
        for _ in range(count):
            begun_ns = clock()
            call()
            times_ns.append(clock() - begun_ns)
        self.add(times_ns)

    @property
    def times_us(self) -> NDArray[np.float64]:
        """All times after the burn-in, shape (n,)."""
        return np.concatenate(self.batches_us[BURN_IN:] or self.batches_us)


def ratio(one: Stopwatch, other: Stopwatch) -> float:
    """Return the median ratio of times over batches that took turns."""
    pairs = zip(one.batches_us, other.batches_us, strict=True)
    ratios = [float(np.median(mine) / np.median(its)) for mine, its in pairs]
    return float(np.median(ratios[BURN_IN:] or ratios))


@contextmanager
def undisturbed(cpus: Collection[int] = ()) -> Iterator[None]:
    """Pin this thread, and those it starts, to processors if allowed, by default to the last one.

    The garbage collector's objects are frozen meanwhile, as the daemon's are, unless some are frozen already.
    """
    if thaw := not gc.get_freeze_count():
        gc.collect()
        gc.freeze()
    before = os.sched_getaffinity(0)
    with suppress(OSError):
        os.sched_setaffinity(0, cpus or {max(before)})
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setaffinity(0, before)
        if thaw:
            gc.unfreeze()


@cache
def floor_us(count_bytes: int) -> float:
    """Return the least time to read a number of bytes once, from the cache that holds them, us.

    It is the median time of the dot product of a buffer of that size with itself.
    """
    buffer, watch = np.ones(max(1, count_bytes // 4), np.float32), Stopwatch()
    for _ in range(BURN_IN + 1):
        watch.time(lambda: buffer.dot(buffer), FLOOR_CALLS)
    return spread(watch.times_us).p50
