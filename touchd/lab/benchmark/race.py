"""Time and score all estimators on the same touches, in turns with the bare network."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from touchd.evaluation.metrics import position_scores
from touchd.lab.benchmark.estimators import Estimator, Place
from touchd.lab.benchmark.results import BareTimes, EstimatorResult, percentiles, rounded
from touchd.lab.benchmark.scenes import BLOCK, Block
from touchd.lab.benchmark.stopwatch import Stopwatch, floor_us, ratio, spread

Tick = Callable[[], object]


@dataclass(slots=True)
class _Entry:
    estimator: Estimator
    watch: Stopwatch = field(default_factory=Stopwatch)
    beside: Stopwatch = field(default_factory=Stopwatch)
    """Times of the bare network in the same turns."""
    places: list[Place] = field(default_factory=list)


def race(
    estimators: Sequence[Estimator],
    bare: Callable[[], object],
    blocks: Sequence[Block],
    passes: int,
    limit_s: float,
    tick: Tick = lambda: None,
) -> tuple[BareTimes, list[EstimatorResult]]:
    """Time and score every estimator: each takes a block of touches, in turns with a batch of the bare network.

    No pass over the blocks starts after `limit_s`. `tick` is called after each block.
    """
    entries = [_Entry(one) for one in estimators]
    begun_s = time.monotonic()
    for number in range(passes):
        if number and time.monotonic() - begun_s > limit_s:
            break
        for block in blocks:
            for entry in entries:
                entry.beside.time(bare, BLOCK)
                places = _batch(entry, block)
                if not number:
                    entry.places += places
            tick()
    true_mm = np.concatenate([block.true_mm for block in blocks])
    bare_us = spread(np.concatenate([entry.beside.times_us for entry in entries]))
    return BareTimes.of(bare_us), [_result(entry, true_mm) for entry in entries]


def _batch(entry: _Entry, block: Block) -> list[Place]:
    """Locate the touches of a block, one by one."""
    estimator, clock = entry.estimator, time.perf_counter_ns
    prepare, locate = estimator.prepare, estimator.locate
    estimator.rebase(block)
    times_ns, places = [], []
    for before, residual in zip(block.before, block.residual, strict=True):
        prepare(before)
        begun_ns = clock()
        place = locate(residual)
        times_ns.append(clock() - begun_ns)
        places.append(place)
    entry.watch.add(times_ns)
    return places


def _result(entry: _Entry, true_mm: np.ndarray) -> EstimatorResult:
    estimator, times_us = entry.estimator, entry.watch.times_us
    found = np.array([place is not None for place in entry.places])
    error_mm = np.array([place for place in entry.places if place is not None]).reshape(-1, 2) - true_mm[found]
    scores = position_scores(error_mm)
    return EstimatorResult(
        name=estimator.name, group=estimator.group, remark=estimator.remark,
        **percentiles(spread(times_us)),
        ratio=rounded(ratio(entry.watch, entry.beside)), floor_us=rounded(floor_us(estimator.bytes)),
        calls=len(times_us), macs=estimator.macs, bytes=estimator.bytes,
        touches=len(found), missed=int((~found).sum()),
        rmse_mm=rounded(scores["rmse_mm"]), median_mm=rounded(scores["median_mm"]), p95_mm=rounded(scores["p95_mm"]),
    )  # fmt: skip
