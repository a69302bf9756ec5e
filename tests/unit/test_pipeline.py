"""One frame's way: the same frames give the same events, whoever plays them and however fast."""

from __future__ import annotations

import math
import statistics
import time
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
from touchd.errors import ModelMismatch
from touchd.evaluation.dataset import make_dataset
from touchd.event import Event, KeyEvent, TouchEvent
from touchd.frame import Frame
from touchd.keypad import PHONE, Key, Layout, load_layout
from touchd.localization.features import FrequencyFeatures
from touchd.localization.model import Model
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
    messages = Messages(Settings(), lambda _topic: True, wall_offset_ns=0)
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
    """What the health messages say is wrong."""
    return pipeline.fault


# -- time ------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def chunks(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The taps as a folder of chunks of 37 frames."""
    whole, folder = scene("tap"), tmp_path_factory.mktemp("chunks")
    names = ("frames", "sequence", "timestamp_ns", "contacts_mm", "force_n", "temperature_c")
    for number, start in enumerate(range(0, len(whole.frames), 37)):
        part = {name: getattr(whole, name)[start : start + 37] for name in names}
        write(folder / f"{number:06}.npz", replace(whole, **part), compress=False)
    return folder


@pytest.mark.parametrize("speed", [float("inf"), 20.0])
@pytest.mark.parametrize("chunked", [False, True])
def test_the_same_frames_give_the_same_events_at_any_speed_and_in_any_chunks(
    speed: float,
    chunked: bool,
    scene: Scene,
    scene_file: Callable[[str], Path],
    chunks: Path,
    make: Callable[..., Pipeline],
) -> None:
    expected = contents(run(make(), frames_of(scene("tap"))), 0)
    assert sum(len(e["contacts"]) for e in expected if e["type"] == "touch") > 10
    frames = drain(ReplaySource(chunks if chunked else scene_file("tap"), speed=speed))
    assert contents(run(make(), frames), frames[0].t_ns) == expected


def test_a_live_scene_gives_the_events_of_its_recording(
    scene: Scene, instrument: Instrument, make: Callable[..., Pipeline]
) -> None:
    source = SimulatedSource("tap", seed=21, paced=False, loop=False, instrument=instrument)
    frames = drain(source)
    assert contents(run(make(), frames), frames[0].t_ns) == contents(run(make(), frames_of(scene("tap"))), 0)


# -- what becomes of a frame -----------------------------------------------------------------------


def test_a_frame_is_never_taken_twice(scene: Scene, make: Callable[..., Pipeline]) -> None:
    frames = frames_of(scene("tap"))
    once, twice = make(), make()
    expected = run(once, frames)
    assert run(twice, [frame for frame in frames for _ in range(2)]) == expected
    assert (twice.counters.frames, twice.counters.repeated) == (len(frames), len(frames))
    assert (once.counters.frames, once.counters.repeated) == (len(frames), 0)
    run(twice, frames[-5:-3])
    assert twice.counters.repeated == len(frames) + 2, "a late frame is as old as a repeated one"


def test_a_daq_that_repeats_one_frame_says_nothing_of_the_plate(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """Contacts are lifted, nothing is learned, and what comes after is as it would have been."""
    frames = frames_of(scene("circle"))
    pipeline = make()
    run(pipeline, frames[:300])
    assert pipeline.tracker.alive
    mean, noise, skipped = pipeline.baseline.mean.copy(), pipeline.noise_counts(), dict(pipeline.counters.skipped)
    hour = range(1, 3600 * 125 // 1000)
    again = [structs.replace(frames[299], sequence=300 + n, t_ns=frames[299].t_ns + n * 1000 * PERIOD_NS) for n in hour]
    events = run(pipeline, again)
    assert phases(events) == [(1, "up")]
    assert isinstance(events[0], TouchEvent)
    assert events[0].frame <= 303, "soon"
    assert not pipeline.tracker.busy
    assert fault(pipeline) == "the DAQ repeats one frame"
    assert pipeline.counters.skipped == skipped | {"frozen": len(again)}
    np.testing.assert_array_equal(pipeline.baseline.mean, mean)
    assert pipeline.noise_counts() == noise

    later = [structs.replace(f, sequence=f.sequence + 10_000, t_ns=f.t_ns + 4_000_000_000_000) for f in frames[300:400]]
    touches = [event for event in run(pipeline, later) if isinstance(event, TouchEvent)]
    assert fault(pipeline) is None
    assert pipeline.counters.skipped["learning"] == skipped["learning"]
    assert {c.id for event in touches for c in event.contacts} == {2}, "the finger that is still there"
    whole = {e.frame: e for e in run(make(), frames[:400]) if isinstance(e, TouchEvent)}
    for event in touches[20:]:
        expected = whole[event.frame - 10_000].contacts[0]
        assert math.dist((event.contacts[0].x_mm, event.contacts[0].y_mm), (expected.x_mm, expected.y_mm)) < 2.0


def test_a_daq_that_is_frozen_from_the_start_is_learned_once_it_lives(
    scene: Scene, make: Callable[..., Pipeline]
) -> None:
    frames = frames_of(scene("tap"))
    pipeline = make()
    dead = np.zeros_like(frames[0].counts)
    assert run(pipeline, [structs.replace(f, counts=dead) for f in frames[:50]]) == []
    assert pipeline.counters.skipped["learning"] <= 1
    later = [structs.replace(f, sequence=f.sequence + 50, t_ns=f.t_ns + 50 * PERIOD_NS) for f in frames]
    assert phases(run(pipeline, later)) == phases(run(make(), frames))


def test_health_names_the_channels_that_say_nothing(scene: Scene, make: Callable[..., Pipeline]) -> None:
    frames = frames_of(scene("tap"))
    counts = scene("tap").frames.copy()
    counts[40:, 2] = counts[40, 2]
    pipeline = make()
    run(pipeline, frames[:40])
    assert fault(pipeline) is None
    run(pipeline, [structs.replace(frame, counts=own) for frame, own in zip(frames[40:], counts[40:], strict=True)])
    assert fault(pipeline) == "the DAQ repeats what it heard on channels [2]"
    assert "frozen" not in pipeline.counters.skipped, "the frames are used"


def test_a_device_that_counts_from_the_start_again_is_followed_after_it_was_learned_anew(
    scene: Scene, make: Callable[..., Pipeline]
) -> None:
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
def test_a_network_that_says_nan_places_nothing(
    field: str, scene: Scene, make: Callable[..., Pipeline], model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimate, wrong = model.estimate, cast(Any, {field: math.nan})
    monkeypatch.setattr(model, "estimate", lambda: estimate()._replace(**wrong))
    pipeline = make()
    assert run(pipeline, frames_of(scene("tap"))) == []
    assert pipeline.counters.inferred


def test_lost_frames_are_counted_and_every_frame_is_accounted_for(scene: Scene, make: Callable[..., Pipeline]) -> None:
    frames = frames_of(scene("tap"))
    pipeline = make()
    run(pipeline, [frame for frame in frames if not 300 <= frame.sequence < 317])
    counters = pipeline.counters
    assert (counters.lost, counters.frames) == (17, len(frames) - 17)
    assert sum(counters.skipped.values()) + counters.inferred == counters.frames


def test_the_first_frame_may_bear_any_number(scene: Scene, make: Callable[..., Pipeline]) -> None:
    pipeline = make()
    pipeline.process(structs.replace(frames_of(scene("idle"))[0], sequence=123_456))
    assert pipeline.counters.lost == 0


def test_with_the_gate_closed_neither_features_nor_network_run(
    scene: Scene, make: Callable[..., Pipeline], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: Counter[str] = Counter()

    def counting(name: str, function: Callable[..., None]) -> Callable[..., None]:
        def counted(*arguments: Any) -> None:
            calls[name] += 1
            function(*arguments)

        return counted

    monkeypatch.setattr(Model, "infer", counting("infer", Model.infer))
    monkeypatch.setattr(FrequencyFeatures, "extract", counting("extract", FrequencyFeatures.extract))
    pipeline = make()
    closed = opened = 0
    for frame in frames_of(scene("tap")):
        calls.clear()
        pipeline.process(frame)
        if not pipeline.gate.is_open:
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


def test_an_idle_plate_says_nothing(scene: Scene, make: Callable[..., Pipeline]) -> None:
    pipeline = make()
    assert run(pipeline, frames_of(scene("idle"))) == []
    assert pipeline.counters.inferred == 0
    assert pipeline.noise_counts() > 0


def test_a_model_for_other_frames_is_refused_before_the_first(make: Callable[..., Pipeline], model: Model) -> None:
    other = model.description.acquisition.model_copy(update={"samples": 251})
    with pytest.raises(ModelMismatch):
        make(acquisition=other)


def test_the_daemon_computes_bit_for_bit_what_the_model_was_trained_on(
    instrument: Instrument, make: Callable[..., Pipeline], model: Model
) -> None:
    """A pipeline that has learned the untouched frames beside a touch, against the training set."""
    touches = simulate_touches(120, seed=5, instrument=instrument)
    dataset = make_dataset(touches, model.description.domain)
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
    assert checked == 119


# -- messages --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def keypad() -> dict[str, Any]:
    return {"settings": Settings(), "layout": load_layout(PHONE)}


def test_the_code_that_is_typed_is_the_code_that_arrives(
    scene: Scene, make: Callable[..., Pipeline], keypad: dict[str, Any]
) -> None:
    keys = [event for event in run(make(**keypad), frames_of(scene("keypad"))) if isinstance(event, KeyEvent)]
    assert [(event.key, event.phase) for event in keys] == [
        (key, phase) for key in "2580#" for phase in ("press", "release")
    ]
    assert all(0.5 <= event.confidence <= 1 for event in keys)


def test_in_keypad_mode_a_contact_goes_down_on_its_key_and_otherwise_on_none(
    scene: Scene, make: Callable[..., Pipeline], keypad: dict[str, Any]
) -> None:
    def keys_of(pipeline: Pipeline) -> set[str | None]:
        events = run(pipeline, frames_of(scene("keypad")))
        contacts = [c for event in events if isinstance(event, TouchEvent) for c in event.contacts]
        return {c.key for c in contacts if c.phase == "down"}

    assert keys_of(make(**keypad)) == set("2580#")
    assert keys_of(make()) == {None}


def test_a_release_names_the_key_that_was_pressed_wherever_the_finger_slid(
    scene: Scene, make: Callable[..., Pipeline]
) -> None:
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


def test_contacts_go_down_once_and_up_once_and_an_id_never_comes_again(
    scene: Scene, make: Callable[..., Pipeline]
) -> None:
    changes = phases(run(make(), frames_of(scene("tap"))))
    count = len(changes) // 2
    assert count > 2
    assert changes == [(i + 1, phase) for i in range(count) for phase in ("down", "up")]


def test_when_the_frames_stop_every_contact_is_lifted(scene: Scene, make: Callable[..., Pipeline]) -> None:
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


def test_a_network_that_runs_though_the_gate_is_closed_changes_nothing_but_the_cost(
    scene: Scene, make: Callable[..., Pipeline]
) -> None:
    skipping, running = make(), make(without("gate"))
    assert run(running, frames_of(scene("tap"))) == run(skipping, frames_of(scene("tap")))
    assert running.counters.skipped["gate"] == 0
    assert running.counters.inferred == skipping.counters.inferred + skipping.counters.skipped["gate"]


def test_while_the_screen_is_off_contacts_are_up_and_neither_features_nor_network_run(
    scene: Scene, make: Callable[..., Pipeline]
) -> None:
    frames = frames_of(scene("circle"))
    pipeline = make()
    assert phases(run(pipeline, frames[:300])) == [(1, "down")]
    inferred = pipeline.counters.inferred
    assert ups(pipeline.set_screen(off=True)) == [1]
    assert pipeline.set_screen(off=True).contacts == [], "said twice it is no news"
    assert run(pipeline, frames[300:400]) == []
    assert pipeline.counters.inferred == inferred
    assert pipeline.counters.skipped["screen-off"] == 100
    assert pipeline.set_screen(off=False).contacts == []
    assert phases(run(pipeline, frames[400:450])) == [(2, "down")]
    assert pipeline.counters.frames == pipeline.counters.inferred + sum(pipeline.counters.skipped.values())


def test_a_key_that_is_held_when_the_screen_goes_off_is_released(
    scene: Scene, make: Callable[..., Pipeline], keypad: dict[str, Any]
) -> None:
    pipeline = make(**keypad)
    for frame in frames_of(scene("keypad")):
        if pipeline.process(frame).keys:
            break
    (release,) = pipeline.set_screen(off=True).keys
    assert (release.key, release.phase) == ("2", "release")


def test_the_plate_is_followed_while_the_screen_is_off(scene: Scene, make: Callable[..., Pipeline]) -> None:
    frames = frames_of(scene("idle"))
    awake, asleep = make(), make()
    for pipeline in (awake, asleep):
        run(pipeline, frames[:40])
    asleep.set_screen(off=True)
    for pipeline in (awake, asleep):
        run(pipeline, frames[40:])
    np.testing.assert_array_equal(asleep.baseline.mean, awake.baseline.mean)
    assert asleep.noise_counts() == awake.noise_counts()
    assert asleep.followed_ns == awake.followed_ns == frames[-1].t_ns
    assert asleep.counters.skipped["screen-off"] == len(frames) - 40


def test_what_is_laid_down_while_the_screen_is_off_is_no_touch_when_it_is_on_again(
    scene: Scene, make: Callable[..., Pipeline]
) -> None:
    """It has become part of the plate after its time, as ever."""
    notices: list[str] = []
    settings = Settings.model_validate({"baseline": {"absorb_s": 2.0}})
    pipeline = make(settings, notify=lambda reason, _fields: notices.append(reason))
    recording = scene("hold")
    held = np.flatnonzero(~np.isnan(recording.contacts_mm[:, 0, 0]))  # type: ignore[index]  # the twin tells the truth
    frames = frames_of(recording)
    run(pipeline, frames[: held[0] - 5])
    pipeline.set_screen(off=True)
    assert run(pipeline, frames[held[0] - 5 : held[0] + 400]) == []
    assert notices == ["absorbed"]
    pipeline.set_screen(off=False)
    assert run(pipeline, frames[held[0] + 400 : held[0] + 600]) == []


def test_a_daemon_that_shall_not_skip_for_the_screen_takes_no_note_of_it(
    scene: Scene, make: Callable[..., Pipeline]
) -> None:
    frames = frames_of(scene("tap"))
    ever = make(without("screen"))
    assert ever.set_screen(off=True).contacts == []
    assert not ever.screen_off
    assert run(ever, frames) == run(make(), frames)
    asleep = make()
    asleep.set_screen(off=True)
    asleep.configure(without("screen"), None)
    assert run(asleep, frames) == run(make(), frames), "a configuration that is read again switches it on"


# -- cost ------------------------------------------------------------------------------------------


def test_an_idle_frame_costs_less_than_a_third_of_a_touched_one(scene: Scene, make: Callable[..., Pipeline]) -> None:
    """By the median over rounds in which both kinds take turns, so that another load hits both alike."""
    settings = Settings.model_validate({"baseline": {"absorb_s": 1e6}, "skip": {"still": False}})
    frames = frames_of(scene("circle"))
    idle, touched = make(settings), make(settings)
    run(idle, frames[:40])
    run(touched, frames[:300])
    assert touched.tracker.alive

    def cost_s(pipeline: Pipeline, pair: list[Frame], round_: int) -> float:
        numbers = range(1000 + 25 * round_, 1025 + 25 * round_)
        batch = [structs.replace(pair[n % 2], sequence=n, t_ns=n * PERIOD_NS) for n in numbers]
        started_s = time.perf_counter()
        for frame in batch:
            pipeline.process(frame)
        return time.perf_counter() - started_s

    ratios = [cost_s(idle, frames[37:39], r) / cost_s(touched, frames[298:300], r) for r in range(60)]
    print(f"an idle frame costs {statistics.median(ratios):.2f} of a touched one")
    assert idle.counters.inferred == 0
    assert touched.tracker.alive
    assert statistics.median(ratios) < 1 / 3


def test_counts_are_never_changed(scene: Scene, make: Callable[..., Pipeline]) -> None:
    recording = scene("tap")
    counts = recording.frames.copy()
    counts.flags.writeable = False
    run(make(), frames_of(replace(recording, frames=counts)))
    np.testing.assert_array_equal(counts, recording.frames)
