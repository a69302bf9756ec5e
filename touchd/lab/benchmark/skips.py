"""Measure the time that each skip saves: the same frames pass through two pipelines, with and without it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from pathlib import Path

from touchd.config.schema import Settings
from touchd.event import Event, TouchEvent
from touchd.frame import Frame
from touchd.lab.benchmark.daemon import FOREVER_S
from touchd.lab.benchmark.loop import PERIOD_NS, Loop
from touchd.lab.benchmark.results import EstimatorResult, SkipResult
from touchd.lab.benchmark.stopwatch import Stopwatch, ratio, spread
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service.messages import Messages

BATCH = 25
SCENES = {"gate": "idle", "still": "still", "unheard": "moving", "screen": "moving"}
"""Where each skip is measured; for `unheard` no subscriber wants touches, for `screen` the screen is off."""


class _Played:
    """A pipeline that processes a loop."""

    def __init__(self, name: str, loop: Loop, model: Model, skip: bool) -> None:
        settings = Settings.model_validate(
            {"skip": {name: skip}, "baseline": {"absorb_s": FOREVER_S}, "model": {"path": str(model.path)}}
        )
        self._pipeline = Pipeline(loop.acquisition, model, settings)
        self._messages = Messages(settings, lambda topic: name != "unheard" and topic == "touch")
        self._frames = (Frame(counts, i, i * PERIOD_NS, 0) for i, counts in enumerate(loop.counts()))
        self.watch = Stopwatch()
        self.events: list[Event] = []
        for frame in islice(self._frames, loop.lead):
            self.events += self._take(frame)
        if name == "screen":
            self._pipeline.set_screen(off=True)

    def batch(self) -> None:
        """Process a batch of frames and add their times."""
        clock, times_ns = time.perf_counter_ns, []
        for frame in islice(self._frames, BATCH):
            begun_ns = clock()
            events = self._take(frame)
            times_ns.append(clock() - begun_ns)
            self.events += events
        self.watch.add(times_ns)

    def _take(self, frame: Frame) -> list[Event]:
        """Return the messages of a frame, as the service makes them."""
        result = self._pipeline.process(frame)
        if result.contacts or result.touches:
            return list(self._messages.make(result, self._pipeline.spectrum))
        return []


def measure(
    loops: Mapping[str, Loop],
    path: Path,
    rounds: int,
    estimators: Sequence[EstimatorResult],
    tick: Callable[[], object],
) -> list[SkipResult]:
    """Measure every skip that the configuration can turn off, and add what tracking saves of `estimators`."""
    found = []
    model = Model(path)
    for name, scene in SCENES.items():
        with_it, without = (_Played(name, loops[scene], model, skip) for skip in (True, False))
        for _ in range(rounds):
            with_it.batch()
            without.batch()
        found.append(SkipResult(
            name=name, scene=scene, with_us=spread(with_it.watch.times_us).p50,
            without_us=spread(without.watch.times_us).p50, saved=1 - ratio(with_it.watch, without.watch),
            same="no touches, as asked" if name == "screen" else _compared(with_it.events, without.events),
        ))  # fmt: skip
        tick()
    one = {each.name: each for each in estimators}
    if "atlas, tracking" in one:
        down, followed = one["atlas, touch-down"], one["atlas, tracking"]
        found.append(SkipResult(
            name="tracking", scene="moving", with_us=followed.p50_us, without_us=down.p50_us,
            saved=1 - followed.ratio / down.ratio,
            same=f"median error {followed.median_mm:.3f} mm, with the network {down.median_mm:.3f} mm",
        ))  # fmt: skip
    return found


def _compared(some: list[Event], all_of_them: list[Event]) -> str:
    """Compare the events with a skip to those without."""
    found, others = (
        {(e.frame, contact.id): contact for e in events if isinstance(e, TouchEvent) for contact in e.contacts}
        for events in (some, all_of_them)
    )
    changes, their_changes = (
        [(key, contact.phase) for key, contact in contacts.items() if contact.phase in ("down", "up")]
        for contacts in (found, others)
    )
    if changes != their_changes:
        return f"{len(changes)} contacts come or go, without it {len(their_changes)}"
    common = [(found[key], others[key]) for key in found.keys() & others.keys()]
    if not common:
        return "the same: no touches"
    most = max(math.dist((a.x_mm, a.y_mm), (b.x_mm, b.y_mm)) / b.sigma_mm for a, b in common)
    return "the same" if most == 0 else f"the same contacts, places within {most:.1f} sigma"
