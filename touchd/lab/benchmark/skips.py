"""Measure the time that each skip saves: the same frames pass through two pipelines, with and without it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from touchd.config.schema import Settings
from touchd.event import Event, TouchEvent
from touchd.frame import Frame
from touchd.lab.benchmark.daemon import FOREVER_S
from touchd.lab.benchmark.loop import PERIOD_NS, Loop, LoopSource
from touchd.lab.benchmark.results import EstimatorResult, SkipResult, rounded
from touchd.lab.benchmark.stopwatch import Stopwatch, ratio, spread
from touchd.localization.atlas import Atlas
from touchd.localization.features import band_bins, windowed_dft
from touchd.localization.model import Model
from touchd.service.daemon import make_pipeline
from touchd.service.messages import Messages

BATCH = 25


@dataclass(frozen=True, slots=True)
class _Case:
    name: str
    scene: str
    subscribed: bool = True
    """Whether a subscriber wants touches."""
    screen_off: bool = False


CASES = (
    _Case("gate", "idle"),
    _Case("still", "still"),
    _Case("unheard", "moving", subscribed=False),
    _Case("screen", "moving", screen_off=True),
)


class _Played:
    """A pipeline that processes a loop."""

    def __init__(self, case: _Case, loop: Loop, model: Path, skip: bool) -> None:
        settings = Settings.model_validate(
            {"skip": {case.name: skip}, "baseline": {"absorb_s": FOREVER_S}, "model": {"path": str(model)}}
        )
        source = LoopSource(loop, math.inf, 0.0)
        self._pipeline = make_pipeline(source, settings, Model(model), notify=lambda _reason, _fields: None)
        self._messages = Messages(settings, lambda topic: case.subscribed and topic == "touch")
        self._frames = list(loop.frames)
        self._order = loop.order().tolist()
        self.number = 0
        self.events: list[Event] = []
        for i in range(loop.lead):
            self.events += self._take(Frame(self._frames[i], i, i * PERIOD_NS, 0))
            self.number = i + 1
        if case.screen_off:
            self._pipeline.set_screen(off=True)
        self._lead = loop.lead

    def batch(self, watch: Stopwatch) -> None:
        """Process a batch of frames and add their times."""
        clock, times_ns = time.perf_counter_ns, []
        for _ in range(BATCH):
            counts = self._frames[self._order[(self.number - self._lead) % len(self._order)]]
            frame = Frame(counts, self.number, self.number * PERIOD_NS, 0)
            begun_ns = clock()
            events = self._take(frame)
            times_ns.append(clock() - begun_ns)
            self.number += 1
            self.events += events
        watch.add(times_ns)

    def _take(self, frame: Frame) -> list[Event]:
        """Return the messages of a frame, as the service makes them."""
        result = self._pipeline.process(frame)
        if result.contacts or result.touches:
            return self._messages.make(result, self._pipeline.spectrum)
        return []


def measure(loops: Mapping[str, Loop], model: Path, rounds: int, tick: Callable[[], object]) -> list[SkipResult]:
    """Measure every skip that the configuration can turn off."""
    found = []
    for case in CASES:
        loop = loops[case.scene]
        with_it, without = _Played(case, loop, model, skip=True), _Played(case, loop, model, skip=False)
        one, other = Stopwatch(), Stopwatch()
        for _ in range(rounds):
            with_it.batch(one)
            without.batch(other)
        found.append(SkipResult(
            name=case.name, scene=case.scene, with_us=rounded(spread(one.times_us).p50),
            without_us=rounded(spread(other.times_us).p50), saved=rounded(1 - ratio(one, other), 3),
            same=_compared(case, with_it.events, without.events),
        ))  # fmt: skip
        tick()
    return found


def tracking(estimators: Mapping[str, EstimatorResult]) -> SkipResult | None:
    """Return the time that tracking saves by not running the network; None without an atlas."""
    down, followed = estimators.get("atlas, touch-down"), estimators.get("atlas, tracking")
    if down is None or followed is None:
        return None
    return SkipResult(
        name="tracking", scene="moving", with_us=followed.p50_us, without_us=down.p50_us,
        saved=rounded(1 - followed.ratio / down.ratio, 3),
        same=f"median error {followed.median_mm:.3f} mm, with the network {down.median_mm:.3f} mm",
    )  # fmt: skip


def bins(atlas: Atlas, rounds: int) -> SkipResult:
    """Return the time that the atlas saves by omitting bins without signal."""
    d = atlas.description
    a = d.acquisition
    matrices = [windowed_dft(a, np.array(some)).astype(np.float32) for some in (d.bins, band_bins(a))]
    residual = np.random.default_rng(0).standard_normal(a.shape).astype(np.float32)
    watches = Stopwatch(), Stopwatch()
    for _ in range(rounds):
        for watch, matrix in zip(watches, matrices, strict=True):
            into = np.empty((a.channels, matrix.shape[1]), np.float32)
            watch.time(partial(np.dot, residual, matrix, out=into), BATCH)
    few, many = watches
    return SkipResult(
        name="bins", scene="any", with_us=rounded(spread(few.times_us).p50),
        without_us=rounded(spread(many.times_us).p50), saved=rounded(1 - ratio(few, many), 3),
        same=f"features alone: {len(d.bins)} of {len(band_bins(a))} bins",
    )  # fmt: skip


def _compared(case: _Case, some: list[Event], all_of_them: list[Event]) -> str:
    """Compare the events with a skip to those without."""
    if case.screen_off:
        return "no touches, as asked"
    changes, others = _changes(some), _changes(all_of_them)
    if changes != others:
        return f"{len(changes)} contacts come or go, without it {len(others)}"
    places, theirs = _places(some), _places(all_of_them)
    common = places.keys() & theirs.keys()
    if not common:
        return "the same: no touches"
    shifts = [math.dist(places[key][:2], theirs[key][:2]) / theirs[key][2] for key in common]
    most = float(np.max(shifts))
    return "the same" if most == 0 else f"the same contacts, places within {most:.1f} sigma"


def _contacts(events: list[Event]) -> list[tuple[int, Any]]:
    return [(event.frame, contact) for event in events if isinstance(event, TouchEvent) for contact in event.contacts]


def _changes(events: list[Event]) -> list[tuple[int, int, str]]:
    """Return frame, contact and phase of each contact that goes down or up."""
    return [(frame, c.id, c.phase) for frame, c in _contacts(events) if c.phase in ("down", "up")]


def _places(events: list[Event]) -> dict[tuple[int, int], tuple[float, float, float]]:
    """Return x, y and sigma of every published contact by frame and id, mm."""
    return {(frame, c.id): (c.x_mm, c.y_mm, c.sigma_mm) for frame, c in _contacts(events)}
