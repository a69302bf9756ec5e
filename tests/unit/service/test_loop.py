"""The loop around the pipeline: states, health, latency, and an orderly end, by a clock that the test moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from structlog.testing import capture_logs

from tests.conftest import Scene
from tests.unit.service.bench import PERIOD_NS, START_NS, TIMEOUT_NS, Clock, Keeper, Script, Step
from touchd.config.schema import HealthSettings, Settings
from touchd.detection.clock_skew import LONGEST, STRIDE
from touchd.errors import DeviceLost
from touchd.event import Event, HealthEvent, Latency, TouchEvent
from touchd.frame import Acquisition, Frame
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.recording.data import Recording
from touchd.service.control import Control
from touchd.service.frame_feed import FeedDescription, FrameFeed
from touchd.service.loop import STALL_NS, Service
from touchd.service.rate import QUIET_NS
from touchd.service.realtime import Awake
from touchd.sources.source import Change, Tally


class Bench:
    """A service with a source of its own and sinks that keep everything."""

    def __init__(self, recording: Recording, model: Model, steps: Sequence[Step], period_s: float = 1.0,
                 live: bool = False) -> None:  # fmt: skip
        self.clock = Clock()
        self.source = (Live if live else Script)(recording, steps, self.clock)
        self.sink = Keeper(self.clock, self._heard)
        self.other = Keeper(self.clock)
        self.when: Callable[[Event], None] = lambda _event: None
        sinks = [self.sink, self.other]
        settings = Settings(health=HealthSettings(period_s=period_s))
        self.pipeline = Pipeline(recording.acquisition, model, settings)
        self.service = Service(self.source, sinks, settings, self.pipeline, clock=self.clock)

    def _heard(self, event: Event) -> None:
        self.when(event)


class Adjustable(Script):
    """A source whose rate can be changed; it keeps when it is asked for what, and which contacts were told by then."""

    asked: list[tuple[int, int, list[tuple[int, str]]]]
    sink: Keeper

    def set_rate(self, rate_hz: int) -> bool:
        self.asked.append((self._clock.now_ns - START_NS, rate_hz, self.sink.phases()))
        return True


@pytest.fixture
def circle(scene: Scene) -> list[Frame]:
    """Untouched frames, then a finger that stays on the plate."""
    recording = scene("circle")
    return [Frame(counts, i, 0, 0) for i, counts in enumerate(recording.frames[:300])]


@pytest.fixture
def make(scene: Scene, model: Model) -> Callable[..., Bench]:
    return lambda steps, **options: Bench(scene("circle"), model, steps, **options)


def test_states(make: Callable[..., Bench], circle: list[Frame]) -> None:
    """Each state is published at once, to every sink."""
    silence: list[Step] = [None] * (STALL_NS // TIMEOUT_NS + 5)
    bench = make([None, *circle[:40], *silence, *circle[40:80]], period_s=3600.0)
    bench.service.run()
    assert [event.state for event in bench.sink.health] == ["starting", "streaming", "stalled", "streaming", "stopping"]
    starting, streaming, stalled, again, stopping = (t - START_NS for t in bench.sink.times_ns)
    assert starting == 0
    assert streaming == TIMEOUT_NS + PERIOD_NS, "with the first frame"
    last_frame = streaming + 39 * PERIOD_NS
    assert STALL_NS < stalled - last_frame <= STALL_NS + TIMEOUT_NS
    assert again == last_frame + len(silence) * TIMEOUT_NS + PERIOD_NS
    assert stopping == again + 39 * PERIOD_NS
    assert bench.other.events == bench.sink.events


def test_silent_source(make: Callable[..., Bench]) -> None:
    """A source that never brought a frame has not stalled, and the sinks are polled meanwhile."""
    bench = make([None] * 100)
    bench.service.run()
    assert bench.sink.states() == ["starting", "stopping"]
    assert bench.sink.polls == 100 + 1, "sinks are looked after while no frame comes, and at the end"


def test_period(make: Callable[..., Bench], circle: list[Frame]) -> None:
    """Health comes every period, with or without frames."""
    bench = make([*circle[:250], *[None] * 15], period_s=0.2)
    bench.service.run()
    health_ns = [t for event, t in zip(bench.sink.events, bench.sink.times_ns, strict=True) if event.type == "health"]
    gaps_ns = np.diff(health_ns)
    assert len(gaps_ns) > 10
    assert gaps_ns.max() <= 200_000_000 + TIMEOUT_NS
    # "starting" and "streaming", and "stopping" at the end, come when they come.
    assert gaps_ns[1:-1].min() >= 200_000_000


def test_health_that_nobody_wants(make: Callable[..., Bench]) -> None:
    """Without subscribers health is made every 10 s; the first one has it within 0.1 s, then each second."""
    bench = make([None] * 700, period_s=1.0)
    began_ns = bench.clock()
    for keeper in (bench.sink, bench.other):
        keeper.unwanted = lambda topic: topic == "health" and bench.clock() - began_ns < 25_500_000_000
    bench.service.run()
    times_s = [(at_ns - began_ns) * 1e-9 for at_ns, event in zip(bench.sink.times_ns, bench.sink.events, strict=True)
               if isinstance(event, HealthEvent) and event.state == "starting"]  # fmt: skip
    assert times_s[:3] == pytest.approx([0, 10, 20], abs=0.2)
    assert times_s[3:] == pytest.approx([25.55 + i for i in range(len(times_s) - 3)], abs=0.2)
    assert len(times_s) > 10


def test_counts(make: Callable[..., Bench], circle: list[Frame]) -> None:
    """Health says what became of the frames."""
    bench = make([*circle[:150], *circle[148:160], *circle[165:]])
    bench.service.run()
    last, counters = bench.sink.health[-1], bench.pipeline.counters
    assert (last.frames, last.lost, last.corrupt) == (295, 5, 0)
    assert last.skipped == {**counters.skipped, "repeated": 2}
    assert last.skipped["learning"] == 32
    assert last.inferred == counters.inferred > 0
    assert last.frames == last.inferred + sum(counters.skipped.values())
    assert last.noise > 0
    assert (last.model, last.device) == ("best", Settings().device.name)
    touched_s = counters.inferred * PERIOD_NS * 1e-9
    assert touched_s <= last.baseline_age_s < 3, "the baseline stands still under a finger"


def test_end(make: Callable[..., Bench], circle: list[Frame]) -> None:
    """At the end of the stream contacts are lifted; then the state is `stopping`, and all is closed."""
    bench = make(circle)
    bench.service.run()
    assert bench.sink.phases() == [(1, "down"), (1, "up")]
    up, stopping = bench.sink.events[-2:]
    assert isinstance(up, TouchEvent)
    assert up.frame == circle[-1].sequence
    assert isinstance(stopping, HealthEvent)
    assert stopping.state == "stopping"
    assert (bench.sink.closed, bench.other.closed, bench.source.closed) == (1, 1, 1)


def test_stall(make: Callable[..., Bench], circle: list[Frame]) -> None:
    """Contacts are lifted when the source stalls."""
    bench = make([*circle, *[None] * 25])
    bench.service.run()
    up = next(i for i, e in enumerate(bench.sink.events) if isinstance(e, TouchEvent) and e.contacts[0].phase == "up")
    stalled = bench.sink.events[up + 1]
    assert isinstance(stalled, HealthEvent)
    assert stalled.state == "stalled"
    assert bench.sink.phases() == [(1, "down"), (1, "up")]


def test_stop(make: Callable[..., Bench], circle: list[Frame]) -> None:
    """`stop` ends the loop after the current frame and lifts the contacts."""
    bench = make(circle)

    def stop(event: Event) -> None:
        if isinstance(event, TouchEvent):
            bench.service.stop()

    bench.when = stop
    bench.service.run()
    assert bench.sink.phases() == [(1, "down"), (1, "up")]
    assert len([event for event in bench.sink.events if isinstance(event, TouchEvent)]) == 2
    assert bench.sink.states() == ["starting", "streaming", "stopping"]
    assert bench.pipeline.counters.frames < len(circle)
    assert (bench.sink.closed, bench.source.closed) == (1, 1)


def test_failure(make: Callable[..., Bench], circle: list[Frame]) -> None:
    """The error of a source comes out after an orderly end."""
    bench = make([*circle, DeviceLost("the DAQ is gone")])
    with pytest.raises(DeviceLost):
        bench.service.run()
    assert bench.sink.phases() == [(1, "down"), (1, "up")]
    assert bench.sink.states()[-1] == "stopping"
    assert (bench.sink.closed, bench.other.closed, bench.source.closed) == (1, 1, 1)


def test_awake(make: Callable[..., Bench], circle: list[Frame], tmp_path: Path) -> None:
    """Processors are kept awake while a finger is on the plate, and no longer."""
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    bench = make([*circle, *[None] * 25, *circle[:40]])
    awake = bench.service._awake = Awake(1e9 / PERIOD_NS, device)
    told: list[tuple[str, bool]] = []

    def note(event: Event) -> None:
        told.append((event.state if isinstance(event, HealthEvent) else event.type, awake.held))

    bench.when = note
    bench.service.run()
    assert bench.sink.phases() == [(1, "down"), (1, "up")]
    changes = [pair for before, pair in pairwise([("", False), *told]) if pair[1] != before[1]]
    # At once after the message of the first touch, and until the message of its end is out.
    assert changes == [("touch", True), ("streaming", False)]
    assert not awake.held


class Live(Script):
    """The same with a device's changes of state in the script: one ends a read at once, and is then taken."""

    def __init__(self, recording: Recording, steps: Sequence[Step], clock: Clock) -> None:
        super().__init__(recording, steps, clock)
        self.tally: Tally = Tally()
        self.withholds = ""
        """Why the frames that would come in a timeout are withheld; empty if none comes."""
        self._changes: list[Change] = []

    def read(self, timeout_s: float) -> Frame | None:
        assert not self._changes, "they are taken before the next read"
        if self._steps and isinstance(self._steps[0], Change):
            self._changes.append(self._steps.pop(0))  # type: ignore[arg-type]  # it was just looked at
            return None
        frame = super().read(timeout_s)
        if frame is None and self.withholds:
            self.tally.withheld[self.withholds] = self.tally.withheld.get(self.withholds, 0) + 6
        return frame

    def changes(self) -> list[Change]:
        taken, self._changes = self._changes, []
        return taken


@pytest.fixture
def live(scene: Scene, model: Model) -> Callable[[Sequence[Step]], Bench]:
    return lambda steps: Bench(scene("circle"), model, steps, period_s=3600.0, live=True)


def test_lost(live: Callable[[Sequence[Step]], Bench], circle: list[Frame]) -> None:
    """When a device is lost its contacts are lifted and the state is published at once."""
    bench = live([Change("streaming", "frames arrive"), *circle, Change("lost", "unplugged"), None, None])
    bench.service.run()
    assert bench.sink.phases() == [(1, "down"), (1, "up")]
    up, lost = bench.sink.events[-3:-1]
    assert isinstance(up, TouchEvent)
    assert isinstance(lost, HealthEvent)
    assert (lost.state, lost.reason) == ("lost", "unplugged")
    last_frame_ns = START_NS + len(circle) * PERIOD_NS
    assert bench.sink.times_ns[-3:-1] == [last_frame_ns, last_frame_ns], "no time passes"


def test_relearn(live: Callable[[Sequence[Step]], Bench], circle: list[Frame]) -> None:
    """The plate of a device that was away is relearned, that of one that stalled is not."""
    idle = circle[:60]
    back = Change("streaming", "frames arrive")
    stalled = live(
        [back, *idle, Change("stalled", "silent"), back, *[replace(f, sequence=f.sequence + 60) for f in idle]]
    )
    stalled.service.run()
    assert stalled.pipeline.counters.skipped["learning"] == 32
    lost = live([back, *idle, Change("lost", "gone"), Change("lost", "still"), back, *idle])
    lost.service.run()
    assert lost.pipeline.counters.skipped["learning"] == 64
    assert lost.pipeline.counters.repeated == 0, "its numbers may be any"
    assert [e.reason for e in lost.sink.health if e.state == "lost"] == ["gone", "still"]


@pytest.mark.parametrize("why", ["emitter_fault", "test_pattern"])
def test_withheld(why: str, live: Callable[[Sequence[Step]], Bench], circle: list[Frame]) -> None:
    """Contacts lift 100 ms after the last measurement while a device sends frames that are none; health says why."""
    bench = live([Change("streaming", "frames arrive"), *circle, *[None] * 80])
    assert isinstance(bench.source, Live)
    bench.source.withholds = why
    bench.service.run()
    assert bench.sink.phases() == [(1, "down"), (1, "up")]
    ends_ns = [
        t_ns
        for t_ns, event in zip(bench.sink.times_ns, bench.sink.events, strict=True)
        if isinstance(event, TouchEvent) and event.contacts[0].phase == "up"
    ]
    assert ends_ns == [START_NS + len(circle) * PERIOD_NS + 100_000_000]
    assert bench.sink.states() == ["starting", "streaming", "stopping"]
    assert bench.sink.health[-1].reason == f"the DAQ measures nothing: {why.replace('_', ' ')}"


def test_silent_device(live: Callable[[Sequence[Step]], Bench], circle: list[Frame]) -> None:
    """While a device sends nothing its contacts stay until it reports that it has stalled."""
    bench = live([Change("streaming", "frames arrive"), *circle, *[None] * 19, Change("stalled", "no frame for 1 s")])
    bench.service.run()
    up, stalled = bench.sink.events[-3:-1]
    assert isinstance(up, TouchEvent)
    assert isinstance(stalled, HealthEvent)
    assert bench.sink.times_ns[-3] == START_NS + len(circle) * PERIOD_NS + 19 * TIMEOUT_NS
    assert (stalled.state, stalled.reason) == ("stalled", "no frame for 1 s")


def test_tally(live: Callable[[Sequence[Step]], Bench], circle: list[Frame]) -> None:
    """Health takes a device's own counts for what never reached the pipeline."""
    bench = live([Change("streaming", "frames arrive"), *circle[:40], *circle[60:80]])
    assert isinstance(bench.source, Live)
    bench.source.tally = Tally(lost=3, corrupt=4, behind=13, withheld={"test_pattern": 5}, clipped=6, late=7)
    bench.source.tally.clock_ppm = -2512.34
    bench.service.run()
    last = bench.sink.health[-1]
    assert (last.lost, last.corrupt, last.clipped, last.late, last.clock_ppm) == (3, 4, 6, 7, -2512.3)
    assert (last.skipped["behind"], last.skipped["test_pattern"]) == (13, 5)
    assert "repeated" not in last.skipped


@pytest.mark.parametrize(("late_s", "said"), [(0.4, ""), (12.3, "touches are 12.3 s old")])
def test_late_frames(late_s: float, said: str, make: Callable[..., Bench], circle: list[Frame]) -> None:
    """Health says how late a replay's touches are, once programs drop them."""
    bench = make([replace(frame, t_ns=-round(late_s * 1e9)) for frame in circle])
    bench.service.run()
    told = [event.reason or "" for event in bench.sink.health if event.state == "streaming"][1:]  # after a frame
    assert {reason.partition(",")[0] for reason in told} == {said}


def test_fault(make: Callable[..., Bench], circle: list[Frame]) -> None:
    """Health says while the DAQ repeats one frame; the log says so at most once a period."""
    last = circle[249]
    again = [replace(last, sequence=last.sequence + n) for n in range(1, 251)]
    after = [replace(frame, sequence=frame.sequence + 250) for frame in circle[250:]]
    bench = make([*circle[:250], *again, *after], period_s=0.5)
    with capture_logs() as logs:
        bench.service.run()
    told = [(event.reason, event.skipped.get("frozen", 0)) for event in bench.sink.health]
    assert [reason for reason, _ in told if reason] == ["the DAQ repeats one frame"] * 3, "not in the first 100 ms"
    assert told[0] == (None, 0)
    assert told[-1] == (None, 250)
    warned = [entry["frozen"] for entry in logs if entry["event"] == "frames frozen"]
    assert len(warned) <= 5
    assert sum(warned) == 250
    assert bench.sink.states() == ["starting", "streaming", "stopping"]
    assert bench.sink.phases()[:3] == [(1, "down"), (1, "up"), (2, "down")]


def test_latency(make: Callable[..., Bench], circle: list[Frame]) -> None:
    """Latency is measured up to the last sink, and published for each period."""
    bench = make(circle, period_s=0.5)
    steps_us = iter(range(10, 100_000, 10))
    told: list[int] = []
    periods: list[tuple[list[int], Latency]] = []

    def take_time(event: Event) -> None:
        if isinstance(event, TouchEvent):
            told.append(next(steps_us))
            bench.clock.now_ns += told[-1] * 1000
        elif isinstance(event, HealthEvent):
            periods.append((told.copy(), event.latency_us))
            told.clear()

    bench.when = take_time
    bench.service.run()
    assert sum(bool(latencies) for latencies, _ in periods) >= 3
    assert any(not latencies for latencies, _ in periods)
    for latencies, latency in periods:
        expected = np.percentile(latencies, (50, 99, 100)) if latencies else (0, 0, 0)
        np.testing.assert_allclose((latency.p50, latency.p99, latency.max), expected, atol=0.06)


class Commands(Control):
    """Commands that come with no socket, at a given time."""

    def __init__(self, clock: Clock, due: dict[int, str]) -> None:
        self.listeners, self.polls = [], 0
        self._clock, self._due, self._asking = clock, due, []

    def poll(self) -> list[str]:
        self.polls += 1
        return [self._due.pop(at_ns) for at_ns in sorted(self._due) if at_ns <= self._clock() - START_NS]


class Reading(FrameFeed):
    """A program that takes frames from a time on."""

    def __init__(self, clock: Clock, since_ns: int, acquisition: Acquisition) -> None:
        self.describe = lambda: FeedDescription(acquisition=acquisition, rate_hz=125, source="usb")
        self._clock, self._since_ns = clock, since_ns

    @property
    def listeners(self) -> list[object]:  # type: ignore[override]  # who reads does not matter here
        return [self] if self._clock() - START_NS >= self._since_ns else []

    def send(self, frame: Frame) -> None: ...

    def close(self) -> None: ...


class Scanned:
    """A service whose source has an adjustable rate, on untouched frames and then some with a finger."""

    def __init__(self, scene: Scene, model: Model, idle: int, touched: Sequence[Frame] = (), read_from_s: float = 1e9,
                 commands: dict[int, str] | None = None) -> None:  # fmt: skip
        recording, self.clock = scene("idle"), Clock()
        quiet = [Frame(recording.frames[i % 290], i, 0, 0) for i in range(idle)]
        steps = [*quiet, *(replace(frame, sequence=idle + i) for i, frame in enumerate(touched))]
        self.source, self.sink = Adjustable(recording, steps, self.clock), Keeper(self.clock)
        self.source.asked, self.source.sink = [], self.sink
        self.pipeline = Pipeline(recording.acquisition, model, Settings())
        self.control = Commands(self.clock, commands or {})
        self.service = Service(
            self.source, [self.sink], Settings(), self.pipeline, clock=self.clock, control=self.control,
            feed=Reading(self.clock, round(read_from_s * 1e9), recording.acquisition),
        )  # fmt: skip


def test_scan_rate(scene: Scene, atlas_model: Model, circle: list[Frame]) -> None:
    """The loop asks for few frames of an untouched plate, and for all with the first touched one, once it is told."""
    bench = Scanned(scene, atlas_model, 290, circle[150:290])
    bench.service.run()
    (fell_ns, idle_hz, _), (rose_ns, full_hz, told) = bench.source.asked
    assert (idle_hz, full_hz) == (50, 125)
    learned_ns = 32 * PERIOD_NS
    assert learned_ns + QUIET_NS <= fell_ns <= learned_ns + QUIET_NS + 120e6, "the rate is thought of every 0.1 s"
    assert rose_ns == 291 * PERIOD_NS
    assert told == [(1, "down")]
    assert bench.control.polls < 55, "ten times a second, then twenty"


def test_scan_rate_of_a_dark_screen(scene: Scene, model: Model) -> None:
    """Frames fall to 10 a second within 0.1 s of the screen's going off, and are all there when it comes on."""
    off_ns, on_ns = 500_000_000, 3_000_000_000
    bench = Scanned(scene, model, 430, commands={off_ns: "screen off", on_ns: "screen on"})
    bench.service.run()
    (fell_ns, few_hz, _), (rose_ns, full_hz, _) = bench.source.asked
    assert (few_hz, full_hz) == (10, 125)
    assert off_ns < fell_ns <= off_ns + 100_000_000 + 2 * PERIOD_NS
    assert on_ns < rose_ns <= on_ns + 100_000_000 + 2 * PERIOD_NS


def test_scan_rate_for_a_reader(scene: Scene, model: Model) -> None:
    """A program that begins to take frames of an untouched plate gets all from then on."""
    bench = Scanned(scene, model, 500, read_from_s=3.0)
    bench.service.run()
    assert [rate_hz for _, rate_hz, _ in bench.source.asked] == [50, 125]
    assert 3e9 < bench.source.asked[1][0] <= 3.1e9 + 2 * PERIOD_NS


def test_scan_rate_while_another_pane_is_looked_for(scene: Scene, model: Model) -> None:
    """At another rate frames would begin at other times of its period: the rate falls once none is found."""
    bench = Scanned(scene, model, 1300)
    bench.pipeline.detector.other_chirp.listens = True
    bench.service.run()
    ((fell_ns, idle_hz, _),) = bench.source.asked
    assert idle_hz == 50
    assert fell_ns > STRIDE * LONGEST * PERIOD_NS


def test_idle_bus(scene: Scene, model: Model) -> None:
    """Without a touch and a subscriber frames are examined, and little else: the sinks are polled and commands read ten
    times a second, and health is made every 10 s."""
    bench = Scanned(scene, model, 2500)
    bench.sink.unwanted = lambda _topic: True
    bench.service.run()
    assert bench.pipeline.counters.frames == 2500
    assert 180 <= bench.sink.polls <= 202
    assert 180 <= bench.control.polls <= 202
    states = [event.state for event in bench.sink.health]
    assert states == ["starting", "streaming", "streaming", "stopping"], "one of them in between"
    assert len(bench.sink.events) == len(states) + 1, "and the plate, at the start"
