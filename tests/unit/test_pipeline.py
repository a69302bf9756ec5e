"""The same frames give the same events, at any speed and from any source."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from msgspec import structs

from tests.conftest import Scene
from touchd.config.schema import Settings
from touchd.detection.interference import Interference
from touchd.errors import ModelMismatch
from touchd.evaluation.dataset import make_dataset
from touchd.event import Event, KeyEvent, TouchEvent
from touchd.frame import Frame
from touchd.keypad import PHONE, Key, Layout, load_layout
from touchd.localization.features import Features
from touchd.localization.model import Model
from touchd.localization.noise import NoiseModel
from touchd.pipeline import Pipeline, Result
from touchd.recording.data import Recording
from touchd.recording.format import write
from touchd.service.messages import Messages
from touchd.service.runner import frames_of as read_frames
from touchd.sources.replay import ReplaySource
from touchd.sources.simulated import SimulatedSource
from touchd.sources.source import Source
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

PERIOD_NS = 8_000_000


@pytest.fixture
def make(model: Model) -> Callable[..., Pipeline]:
    """A pipeline for the model's own acquisition."""

    def make(settings: Settings | None = None, **options: Any) -> Pipeline:
        acquisition = options.pop("acquisition", model.description.acquisition)
        return Pipeline(acquisition, model, settings or Settings(), **options)

    return make


def frames_of(recording: Recording) -> list[Frame]:
    rows = zip(recording.frames, recording.sequence.tolist(), recording.timestamp_ns.tolist(), strict=True)
    return [Frame(counts, sequence, t_ns, t_ns) for counts, sequence, t_ns in rows]


def run(pipeline: Pipeline, frames: Iterable[Frame]) -> list[Event]:
    """The messages of some frames, as if somebody wanted all of them."""
    messages = Messages(Settings(), lambda _topic: True, wall_offset=lambda: 0)
    return [event for frame in frames for event in messages.make(pipeline.process(frame), pipeline.spectrum)]


def drain(source: Source) -> list[Frame]:
    """All frames of a source, which may hand out views that it uses again."""
    with closing(source):
        return [structs.replace(f, counts=f.counts.copy()) for f in read_frames(source) if f is not None]


def contents(events: list[Event], first_ns: int) -> list[dict[str, Any]]:
    """Events without what depends on when they were played."""
    found = []
    for event in events:
        content = msgspec.to_builtins(event)
        del content["wall"]
        content["t_ns"] -= first_ns
        found.append(content)
    return found


def phases(events: Iterable[Event]) -> list[tuple[int, str]]:
    """Contacts that go down or up, in order."""
    return [
        (c.id, c.phase) for e in events if isinstance(e, TouchEvent) for c in e.contacts if c.phase in ("down", "up")
    ]


def ups(result: Result) -> list[int]:
    """The contacts that a result ends, and no other."""
    assert all(c.phase == "up" for c in result.contacts)
    return [c.id for c in result.contacts]


def fault(pipeline: Pipeline) -> str | None:
    """What health says is wrong; a function, since the type checker takes a property for constant."""
    return pipeline.detector.fault


def is_touched(pipeline: Pipeline) -> bool:
    return pipeline.touched


def baseline_of(pipeline: Pipeline) -> np.ndarray:
    """What the pipeline holds for the untouched plate: a frame that comes twice says it, and changes nothing."""
    again = Frame(np.zeros((1, 1), np.int16), -(10**9), -(10**9), 0)
    return pipeline.detector.detect(again).baseline.copy()


# -- time ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [10, 50, 125, 500])
def test_slow_followers(rate_hz: int, scene: Scene, atlas_model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """What follows the noise slowly takes one untouched frame in about 128 ms at any rate."""
    taken: Counter[str] = Counter()
    for owner, name in ((NoiseModel, "update"), (Interference, "update")):
        monkeypatch.setattr(owner, name, lambda *_, of=owner.__name__: taken.update([of]))
    frames, learned, seconds = scene("idle").frames, 60, max(1.5, 100 / rate_hz)
    pipeline = Pipeline(atlas_model.description.acquisition, atlas_model, Settings())
    for n in range(1, learned + round(seconds * rate_hz)):
        if n == learned:
            taken.clear()
        t_ns = n * 1_000_000_000 // rate_hz
        pipeline.process(Frame(frames[n % len(frames)], n, t_ns, t_ns))
    assert set(taken) == {"NoiseModel", "Interference"}
    for count in taken.values():
        assert seconds / (0.128 + 1 / rate_hz) - 1 <= count <= seconds / 0.1 + 1


@pytest.fixture(scope="session")
def chunks(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The taps as a folder of chunks of 37 frames."""
    whole, folder = scene("tap"), tmp_path_factory.mktemp("chunks")
    names = ("frames", "sequence", "timestamp_ns", "contacts_mm", "force_n", "faces", "temperature_c")
    for number, start in enumerate(range(0, len(whole.frames), 37)):
        part = {name: getattr(whole, name)[start : start + 37] for name in names}
        write(folder / f"{number:06}.npz", replace(whole, **part), compress=False)
    return folder


@pytest.mark.parametrize("speed", [float("inf"), 20.0])
@pytest.mark.parametrize("chunked", [False, True])
def test_any_speed(
    speed: float,
    chunked: bool,
    scene: Scene,
    scene_file: Callable[[str], Path],
    chunks: Path,
    make: Callable[..., Pipeline],
) -> None:
    """The same frames give the same events, at any speed and in any chunks."""
    expected = contents(run(make(), frames_of(scene("tap"))), 0)
    assert sum(len(e["contacts"]) for e in expected if e["type"] == "touch") > 10
    frames = drain(ReplaySource(chunks if chunked else scene_file("tap"), speed=speed))
    assert contents(run(make(), frames), frames[0].t_ns) == expected


def test_live_scene(scene: Scene, instrument: Instrument, make: Callable[..., Pipeline]) -> None:
    """A live scene gives the events of its recording."""
    source = SimulatedSource("tap", seed=21, paced=False, loop=False, instrument=instrument)
    frames = drain(source)
    assert contents(run(make(), frames), frames[0].t_ns) == contents(run(make(), frames_of(scene("tap"))), 0)


# -- what becomes of a frame -----------------------------------------------------------------------


def test_repeated_frames(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """A frame whose number is not new is dropped."""
    frames = frames_of(scene("tap"))
    once, twice = make(), make()
    expected = run(once, frames)
    assert run(twice, [frame for frame in frames for _ in range(2)]) == expected
    assert (twice.counters.frames, twice.counters.repeated) == (len(frames), len(frames))
    assert (once.counters.frames, once.counters.repeated) == (len(frames), 0)
    run(twice, frames[-5:-3])
    assert twice.counters.repeated == len(frames) + 2, "a late frame counts as repeated"


def test_hanging_daq(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """A DAQ that repeats one frame ends the contacts and teaches nothing; then all goes on as before."""
    frames = frames_of(scene("circle"))
    pipeline = make()
    run(pipeline, frames[:300])
    assert is_touched(pipeline)
    mean, noise, skipped = baseline_of(pipeline), pipeline.detector.noise_counts(), dict(pipeline.counters.skipped)
    hour = range(1, 3600 * 125 // 1000)
    again = [structs.replace(frames[299], sequence=300 + n, t_ns=frames[299].t_ns + n * 1000 * PERIOD_NS) for n in hour]
    events = run(pipeline, again)
    assert phases(events) == [(1, "up")]
    assert isinstance(events[0], TouchEvent)
    assert not is_touched(pipeline)
    assert fault(pipeline) == "the DAQ repeats one frame"
    assert pipeline.counters.skipped == skipped | {"frozen": len(again)}
    np.testing.assert_array_equal(baseline_of(pipeline), mean)
    assert pipeline.detector.noise_counts() == noise

    later = [structs.replace(f, sequence=f.sequence + 10_000, t_ns=f.t_ns + 4_000_000_000_000) for f in frames[300:400]]
    touches = [event for event in run(pipeline, later) if isinstance(event, TouchEvent)]
    assert fault(pipeline) is None
    assert pipeline.counters.skipped["learning"] == skipped["learning"]
    assert {c.id for event in touches for c in event.contacts} == {2}, "the finger that is still there"
    whole = {e.frame: e for e in run(make(), frames[:400]) if isinstance(e, TouchEvent)}
    for event in touches[20:]:
        expected = whole[event.frame - 10_000].contacts[0]
        assert math.dist((event.contacts[0].x_mm, event.contacts[0].y_mm), (expected.x_mm, expected.y_mm)) < 2.0


NUMBER_FAULT = "the DAQ's frame number stands still or runs back"


@pytest.mark.parametrize(
    ("length", "step", "fault_"),
    [
        (250, 0, NUMBER_FAULT),
        (250, -1, NUMBER_FAULT),
        (1, 1, "the DAQ repeats one frame"),
        *[(length, 1, f"the DAQ repeats its last {length} frames") for length in (2, 3, 5, 8)],
    ],
)
@pytest.mark.parametrize("rate_hz", [125, 1000])
def test_liveness(
    length: int, step: int, fault_: str, rate_hz: int, scene: Scene, make: Callable[..., Pipeline]
) -> None:
    """Contacts lift 100 ms after the last measurement while frames come that are none, and health says why."""
    period_ns = 1_000_000_000 // rate_hz
    frames = [structs.replace(f, t_ns=f.sequence * period_ns) for f in frames_of(scene("circle"))]
    pipeline = make()
    assert phases(run(pipeline, frames[:300])) == [(1, "down")]
    events: list[Event] = []
    ends_s = []
    for n in range(1, 4 * rate_hz):  # the last `length` frames over and over, each numbered `step` after the one before
        counts = frames[300 - length + (n - 1) % length].counts
        new = run(pipeline, [Frame(counts, 299 + n * step, (299 + n) * period_ns, 0)])
        ends_s += [n / rate_hz for _, phase in phases(new) if phase == "up"]
        events += new
    assert phases(events) == [(1, "up")]
    assert ends_s[0] <= 0.1 + 1 / rate_hz
    assert ends_s[0] >= 0.1 or step < 0, "a number that runs far back is a restart, after which the plate is learned"
    assert fault(pipeline) == fault_


def test_taps_in_a_cycle(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """A cycle that holds the moment when a finger comes down taps twice more at most."""
    recording, frames = scene("tap"), frames_of(scene("tap"))
    assert recording.contacts_mm is not None
    down = int(np.flatnonzero(np.isfinite(recording.contacts_mm[:, 0, 0]))[0])
    pipeline = make()
    run(pipeline, frames[: down + 4])
    again = [
        structs.replace(frames[down - 4 + n % 8], sequence=down + 4 + n, t_ns=frames[down + 4].t_ns + n * PERIOD_NS)
        for n in range(1000)
    ]
    assert len(phases(run(pipeline, again))) <= 5
    assert not is_touched(pipeline)


@pytest.mark.parametrize("wide", [True, False])
def test_creeping(wide: bool, scene: Scene, make: Callable[..., Pipeline]) -> None:
    """`fault` names interference while what creeps in phase keeps the gate open; a tone is taken out instead."""
    frames = frames_of(scene("idle"))
    shape, pipeline = frames[0].counts.shape, make()
    turn = 2 * np.pi * 0.3 * np.arange(shape[0] * shape[1]).reshape(shape)
    if wide:
        turn = np.random.default_rng(1).uniform(0, 2 * np.pi, shape)
    for n in range(1000):
        change = 150 * np.sin(turn + 0.003 * n) if n >= 100 else np.zeros(shape)
        counts = np.asarray(np.rint(frames[n % len(frames)].counts + change), np.int16)
        pipeline.process(Frame(counts, n, n * PERIOD_NS, 0))
        if n in (100, 300):
            assert fault(pipeline) is None
    interference = "the signal changes and no finger explains it: interference or water"
    assert fault(pipeline) == (interference if wide else None)
    run(
        pipeline,
        [structs.replace(frame, sequence=1000 + n, t_ns=(1000 + n) * PERIOD_NS) for n, frame in enumerate(frames)],
    )
    assert fault(pipeline) is None


def test_daq_stuck_from_the_start(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """A DAQ that hangs from the start is learned once it lives."""
    frames = frames_of(scene("tap"))
    pipeline = make()
    dead = np.zeros_like(frames[0].counts)
    assert run(pipeline, [structs.replace(f, counts=dead) for f in frames[:50]]) == []
    assert pipeline.counters.skipped["learning"] <= 1
    later = [structs.replace(f, sequence=f.sequence + 50, t_ns=f.t_ns + 50 * PERIOD_NS) for f in frames]
    assert phases(run(pipeline, later)) == phases(run(make(), frames))


def test_stuck_channel(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """`fault` names the stuck channels, and their frames are used."""
    frames = frames_of(scene("tap"))
    counts = scene("tap").frames.copy()
    counts[40:, 2] = counts[40, 2]
    pipeline = make()
    run(pipeline, frames[:40])
    assert fault(pipeline) is None
    run(pipeline, [structs.replace(frame, counts=own) for frame, own in zip(frames[40:], counts[40:], strict=True)])
    assert fault(pipeline) == "the DAQ repeats what it heard on channels [2]"
    assert "frozen" not in pipeline.counters.skipped, "the frames are used"


def test_restarted_device(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """A device that counts from the start again is relearned, and every touch is found again."""
    frames = frames_of(scene("tap"))
    notices: list[str] = []
    pipeline = make(notify=lambda reason, _fields: notices.append(reason))
    once = phases(run(pipeline, frames))
    later_ns = frames[-1].t_ns + PERIOD_NS
    again = phases(run(pipeline, [structs.replace(frame, t_ns=frame.t_ns + later_ns) for frame in frames]))
    assert notices == ["restarted"]
    assert [phase for _, phase in again] == [phase for _, phase in once], "every touch is found again"
    assert {i for i, _ in again}.isdisjoint({i for i, _ in once}), "under an id of its own"
    counters = pipeline.counters
    assert (counters.frames, counters.lost, counters.repeated) == (2 * len(frames), 0, 0)


@pytest.mark.parametrize("field", ["confidence", "sigma_mm", "noise_mm"])
def test_nan(
    field: str, scene: Scene, make: Callable[..., Pipeline], model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network that says NaN places nothing."""
    estimate, wrong = model.estimate, cast(Any, {field: math.nan})
    monkeypatch.setattr(model, "estimate", lambda: estimate()._replace(**wrong))
    pipeline = make()
    assert run(pipeline, frames_of(scene("tap"))) == []
    assert pipeline.counters.inferred


def test_lost_frames(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """Lost frames are counted."""
    frames = frames_of(scene("tap"))
    pipeline = make()
    run(pipeline, [frame for frame in frames if not 300 <= frame.sequence < 317])
    counters = pipeline.counters
    assert (counters.lost, counters.frames) == (17, len(frames) - 17)
    assert sum(counters.skipped.values()) + counters.inferred == counters.frames


def test_first_number(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """The first frame may have any number."""
    pipeline = make()
    pipeline.process(structs.replace(frames_of(scene("idle"))[0], sequence=123_456))
    assert pipeline.counters.lost == 0


def test_closed_gate(scene: Scene, make: Callable[..., Pipeline], monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither features nor network run while the gate is closed."""
    calls: Counter[str] = Counter()

    def counting(name: str, function: Callable[..., None]) -> Callable[..., None]:
        def counted(*arguments: Any) -> None:
            calls[name] += 1
            function(*arguments)

        return counted

    monkeypatch.setattr(Model, "infer", counting("infer", Model.infer))
    monkeypatch.setattr(Features, "extract", counting("extract", Features.extract))
    pipeline = make()
    closed = opened = 0
    for frame in frames_of(scene("tap")):
        calls.clear()
        pipeline.process(frame)
        if not pipeline.detector.gate.is_open:
            closed += 1
            assert not calls
        elif pipeline.counters.inferred > opened:
            opened += 1
            assert 1 <= calls["extract"] <= 2, "the second for the spectrum"
            assert 1 <= calls["infer"] <= 2, "the second for its negative: is it a finger that has gone?"
        else:
            assert not calls["infer"], "too faint to be looked at, or nothing has changed"
    assert opened > 20
    assert closed > 100
    assert pipeline.counters.inferred == opened
    assert pipeline.counters.skipped["learning"] + pipeline.counters.skipped["gate"] == closed


def test_idle(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """An idle plate makes no message."""
    pipeline = make()
    assert run(pipeline, frames_of(scene("idle"))) == []
    assert pipeline.counters.inferred == 0
    assert pipeline.detector.noise_counts() > 0


def test_other_frames(make: Callable[..., Pipeline], model: Model) -> None:
    """A model for other frames is refused."""
    other = model.description.acquisition.model_copy(update={"samples": 251})
    with pytest.raises(ModelMismatch):
        make(acquisition=other)


def test_features_of_training(instrument: Instrument, make: Callable[..., Pipeline], model: Model) -> None:
    """The network gets what it was trained on, bit for bit."""
    touches = simulate_touches(40, seed=5, instrument=instrument)
    dataset = make_dataset(touches, model.description.domain, least=40)
    settings = Settings.model_validate({"baseline": {"learn_frames": 2}})
    assert model.description.input == "residual"
    checked = 0
    for i, row in enumerate(dataset.residual[:-1]):
        pipeline = make(settings)
        # An untouched frame, the touch, an untouched frame: learned are the first and the last.
        for sequence, at in enumerate((2 * i, 2 * i + 2, 2 * i + 1)):
            pipeline.process(Frame(touches.frames[at], sequence, sequence * PERIOD_NS, 0))
        assert pipeline.counters.inferred == 1
        assert model.features[0].tobytes() == row.tobytes()
        checked += 1
    assert checked == 39


# -- messages --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def keypad() -> dict[str, Any]:
    return {"settings": Settings(), "layout": load_layout(PHONE)}


def test_code(scene: Scene, make: Callable[..., Pipeline], keypad: dict[str, Any]) -> None:
    """The code that is typed is the code that arrives."""
    keys = [event for event in run(make(**keypad), frames_of(scene("keypad"))) if isinstance(event, KeyEvent)]
    assert [(event.key, event.phase) for event in keys] == [
        (key, phase) for key in "2580#" for phase in ("press", "release")
    ]
    assert all(0.5 <= event.confidence <= 1 for event in keys)


def test_keys(scene: Scene, make: Callable[..., Pipeline], keypad: dict[str, Any]) -> None:
    """A contact goes down on its key in keypad mode, and on none otherwise."""

    def keys_of(pipeline: Pipeline) -> set[str | None]:
        events = run(pipeline, frames_of(scene("keypad")))
        contacts = [c for event in events if isinstance(event, TouchEvent) for c in event.contacts]
        return {c.key for c in contacts if c.phase == "down"}

    assert keys_of(make(**keypad)) == set("2580#")
    assert keys_of(make()) == {None}


def test_slide(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """A release names the key that was pressed, although the finger slid to another."""
    quarters = [
        Key(name=f"{row}{column}", x_mm=100 * column, y_mm=100 * row, width_mm=100, height_mm=100)
        for row in (0, 1)
        for column in (0, 1)
    ]
    events = run(make(layout=Layout(key=tuple(quarters))), frames_of(scene("swipe")))
    under = {c.key for event in events if isinstance(event, TouchEvent) for c in event.contacts if c.id == 1}
    assert len(under) > 1, "the finger slid from one key to another"
    keys = [event for event in events if isinstance(event, KeyEvent)]
    assert len(keys) > 1
    assert [event.phase for event in keys] == ["press", "release"] * (len(keys) // 2)
    assert [event.key for event in keys[::2]] == [event.key for event in keys[1::2]]


def test_ids(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """Contacts go down once and up once, and an id never comes again."""
    changes = phases(run(make(), frames_of(scene("tap"))))
    count = len(changes) // 2
    assert count > 2
    assert changes == [(i + 1, phase) for i in range(count) for phase in ("down", "up")]


def test_release(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """When the frames stop every contact is lifted; when they go on it is another."""
    pipeline = make()
    frames = frames_of(scene("circle"))
    assert phases(run(pipeline, frames[:300])) == [(1, "down")]
    result = pipeline.release(frames[299].t_ns)
    assert ups(result) == [1]
    assert (result.t_ns, result.sequence) == (frames[299].t_ns, frames[299].sequence)
    assert pipeline.release(frames[299].t_ns).contacts == [], "nothing is lifted twice"
    assert phases(run(pipeline, frames[300:400])) == [(2, "down")], "it goes on, under another id"


# -- what is skipped -------------------------------------------------------------------------------


def without(skip: str) -> Settings:
    return Settings.model_validate({"skip": {skip: False}})


def test_skip_gate_off(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """A network that runs on untouched frames changes nothing but the cost."""
    skipping, running = make(), make(without("gate"))
    assert run(running, frames_of(scene("tap"))) == run(skipping, frames_of(scene("tap")))
    assert running.counters.skipped["gate"] == 0
    assert running.counters.inferred == skipping.counters.inferred + skipping.counters.skipped["gate"]


def test_screen_off(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """While the screen is off contacts are up and the network does not run."""
    frames = frames_of(scene("circle"))
    pipeline = make()
    assert phases(run(pipeline, frames[:300])) == [(1, "down")]
    inferred = pipeline.counters.inferred
    assert ups(pipeline.set_screen(off=True)) == [1]
    assert pipeline.set_screen(off=True).contacts == [], "the second time"
    assert run(pipeline, frames[300:400]) == []
    assert pipeline.counters.inferred == inferred
    assert pipeline.counters.skipped["screen-off"] == 100
    assert pipeline.set_screen(off=False).contacts == []
    assert phases(run(pipeline, frames[400:450])) == [(2, "down")]
    assert pipeline.counters.frames == pipeline.counters.inferred + sum(pipeline.counters.skipped.values())


def test_all_frames_are_needed_while_another_pane_is_heard(make: Callable[..., Pipeline]) -> None:
    pipeline = make()
    needed = [pipeline.needs_all_frames]
    pipeline.detector.other_chirp.known = True
    needed.append(pipeline.needs_all_frames)
    pipeline.set_screen(off=True)
    assert [*needed, pipeline.needs_all_frames] == [False, True, False]


def test_key_and_screen(scene: Scene, make: Callable[..., Pipeline], keypad: dict[str, Any]) -> None:
    """A key that is held when the screen goes off is released."""
    pipeline = make(**keypad)
    for frame in frames_of(scene("keypad")):
        if pipeline.process(frame).keys:
            break
    (release,) = pipeline.set_screen(off=True).keys
    assert (release.key, release.phase) == ("2", "release")


def test_baseline_and_screen(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """The baseline follows the plate while the screen is off."""
    frames = frames_of(scene("idle"))
    awake, asleep = make(), make()
    for pipeline in (awake, asleep):
        run(pipeline, frames[:40])
    asleep.set_screen(off=True)
    for pipeline in (awake, asleep):
        run(pipeline, frames[40:])
    np.testing.assert_array_equal(baseline_of(asleep), baseline_of(awake))
    assert asleep.detector.noise_counts() == awake.detector.noise_counts()
    assert asleep.detector.followed_ns == awake.detector.followed_ns == frames[-1].t_ns
    assert asleep.counters.skipped["screen-off"] == len(frames) - 40


def test_object_and_screen(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """What is laid down while the screen is off becomes part of the plate."""
    notices: list[str] = []
    settings = Settings.model_validate({"baseline": {"absorb_s": 1.0}})
    pipeline = make(settings, notify=lambda reason, _fields: notices.append(reason))
    recording = scene("hold")
    held = np.flatnonzero(~np.isnan(recording.contacts_mm[:, 0, 0]))  # type: ignore[index]  # the twin tells the truth
    frames = frames_of(recording)
    run(pipeline, frames[: held[0] - 5])
    pipeline.set_screen(off=True)
    assert run(pipeline, frames[held[0] - 5 : held[0] + 200]) == []
    assert notices == ["absorbed"]
    pipeline.set_screen(off=False)
    assert run(pipeline, frames[held[0] + 200 : held[0] + 300]) == []


def test_skip_screen_off(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """With `skip.screen` off the screen does not matter; a reloaded configuration switches the pipeline on."""
    frames = frames_of(scene("tap"))
    ever = make(without("screen"))
    assert ever.set_screen(off=True).contacts == []
    assert not ever.screen_off
    assert run(ever, frames) == run(make(), frames)
    asleep = make()
    asleep.set_screen(off=True)
    asleep.configure(without("screen"), None)
    assert run(asleep, frames) == run(make(), frames), "a configuration that is read again switches it on"


def test_counts(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """No frame is written to."""
    recording = scene("tap")
    counts = recording.frames.copy()
    counts.flags.writeable = False
    run(make(), frames_of(replace(recording, frames=counts)))
    np.testing.assert_array_equal(counts, recording.frames)
