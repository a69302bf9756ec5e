"""Measure the time that each skip saves: the same frames pass through two pipelines, with and without it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from touchd.config.schema import Settings
from touchd.event import Contact, Event, TouchEvent
from touchd.frame import Frame
from touchd.lab.benchmark.daemon import FOREVER_S
from touchd.lab.benchmark.loop import PERIOD_NS, Loop, LoopSource
from touchd.lab.benchmark.results import EstimatorResult, SkipResult, rounded
from touchd.lab.benchmark.stopwatch import Stopwatch, ratio, spread
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

    def __init__(self, case: _Case, loop: Loop, model: Model, skip: bool) -> None:
        settings = Settings.model_validate(
            {"skip": {case.name: skip}, "baseline": {"absorb_s": FOREVER_S}, "model": {"path": str(model.path)}}
        )
        source = LoopSource(loop, math.inf, 0.0)
        self._pipeline = make_pipeline(source, settings, model, notify=lambda _reason, _fields: None)
        self._messages = Messages(settings, lambda topic: case.subscribed and topic == "touch")
        self._frames = (Frame(counts, i, i * PERIOD_NS, 0) for i, counts in enumerate(loop.counts()))
        self.events: list[Event] = []
        for frame in islice(self._frames, loop.lead):
            self.events += self._take(frame)
        if case.screen_off:
            self._pipeline.set_screen(off=True)

    def batch(self, watch: Stopwatch) -> None:
        """Process a batch of frames and add their times."""
        clock, times_ns = time.perf_counter_ns, []
        for frame in islice(self._frames, BATCH):
            begun_ns = clock()
            events = self._take(frame)
            times_ns.append(clock() - begun_ns)
            self.events += events
        watch.add(times_ns)

    def _take(self, frame: Frame) -> list[Event]:
        """Return the messages of a frame, as the service makes them."""
        result = self._pipeline.process(frame)
        if result.contacts or result.touches:
            return list(self._messages.make(result, self._pipeline.spectrum))
        return []


def measure(loops: Mapping[str, Loop], model: Path, rounds: int, tick: Callable[[], object]) -> list[SkipResult]:
    """Measure every skip that the configuration can turn off."""
    found = []
    loaded = Model(model)
    for case in CASES:
        loop = loops[case.scene]
        with_it, without = _Played(case, loop, loaded, skip=True), _Played(case, loop, loaded, skip=False)
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


def _compared(case: _Case, some: list[Event], all_of_them: list[Event]) -> str:
    """Compare the events with a skip to those without."""
    if case.screen_off:
        return "no touches, as asked"
    found, others = _contacts(some), _contacts(all_of_them)
    changes, their_changes = (
        [(key, c.phase) for key, c in contacts.items() if c.phase in ("down", "up")] for contacts in (found, others)
    )
    if changes != their_changes:
        return f"{len(changes)} contacts come or go, without it {len(their_changes)}"
    common = [(found[key], others[key]) for key in found.keys() & others.keys()]
    if not common:
        return "the same: no touches"
    most = max(math.dist((a.x_mm, a.y_mm), (b.x_mm, b.y_mm)) / b.sigma_mm for a, b in common)
    return "the same" if most == 0 else f"the same contacts, places within {most:.1f} sigma"


def _contacts(events: list[Event]) -> dict[tuple[int, int], Contact]:
    """Return every published contact by frame and id."""
    return {(e.frame, contact.id): contact for e in events if isinstance(e, TouchEvent) for contact in e.contacts}
