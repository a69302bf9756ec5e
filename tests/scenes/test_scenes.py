"""What the plate goes through in use, from the twin's frames to the events: found once each, and no ghosts."""

import itertools
import math

import numpy as np
import pytest

from tests.scenes.stages import empty_stage, play, score
from tests.system.soak.interpolated import Interpolated
from touchd.cli.demo import SESSION
from touchd.config.schema import Settings
from touchd.evaluation.metrics import position_scores
from touchd.evaluation.replay_scores import StreamScores, score_stream
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.event import TouchEvent
from touchd.frame import Frame
from touchd.localization.model import Model, default_model_path
from touchd.pipeline import Pipeline
from touchd.recording.format import read
from touchd.service.replay import Replayed, replay
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.scenes.timeline import still
from touchd.twin.simulate import DEFAULT_PLATE, simulate_touches


def scene(name: str, instrument: Instrument, seed: int) -> tuple[StreamScores, Replayed]:
    """What was found in a scene of the command line, and all that came of it."""
    stage = stage_scene(name, DEFAULT_PLATE, seed=seed)
    outcome = play(stage, instrument, seed)
    return score(stage, outcome), outcome


@pytest.fixture(scope="module")
def interpolated() -> Interpolated:
    """The default plate, where the coupled forces of a soft finger take seconds: it errs below the noise."""
    return Interpolated(DEFAULT_PLATE)


@pytest.mark.parametrize("name", ["tap", "swipe", "keypad", "circle", "hold", "lostframes", "clipping", "drift"])
@pytest.mark.parametrize("seed", [11, 12])
def test_every_touch_is_found_once_and_nothing_else(name: str, seed: int, instrument: Instrument) -> None:
    result, _ = scene(name, instrument, seed)
    print(f"{name} {seed}: {result.found} of {result.touches}, {position_scores(result.error_mm)}")
    assert (result.missed, result.ghosts, result.split) == (0, 0, 0)
    assert result.clean
    assert np.median(np.linalg.norm(result.error_mm, axis=1)) < 3.0


def test_a_stroke_beside_a_finger_that_is_absorbed(instrument: Instrument) -> None:
    """A finger that has rested for `absorb_s` is absorbed after a stroke beside it, which is one contact to its end."""
    stage = empty_stage(9.0, seed=2500801)
    stage.lay("human", 0.8, 8.7, still(50.0, 150.0), force_n=0.6)

    def circle(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 130 + 30 * np.cos(2.5 * t), 130 + 30 * np.sin(2.5 * t)

    stage.lay("silicone", 1.5, 7.0, circle, force_n=2.0, column=1)
    settings = Settings.model_validate({"baseline": {"absorb_s": 4.0}})
    outcome = play(stage, instrument, seed=2500801, settings=settings)
    ends_s = [event.t_ns * 1e-9 for event in outcome.touches for c in event.contacts if c.phase == "up"]
    assert len(ends_s) == 2
    assert 6.9 < ends_s[0] < 7.1, "the stroke's"
    assert ends_s[0] + 0.2 < ends_s[1] < 7.5, "the finger's that rests"
    assert [reason for reason, _ in outcome.notices] == ["absorbed", "lifted"]


@pytest.mark.parametrize("speed_mm_s", [1000, 1500, 2000])
def test_a_finger_that_lands_as_it_flicks_is_one_contact(speed_mm_s: float, instrument: Instrument) -> None:
    """It goes farther from frame to frame than a fit follows, before its velocity is known."""
    stage = empty_stage(4.0, seed=3)
    for k, angle in enumerate((0.1, 1.7, 2.9, 4.2, 5.3)):
        seconds = 120 / speed_mm_s
        way = np.array([math.cos(angle), math.sin(angle)])
        start_s = 1.0 + 0.5 * k

        def path(t: np.ndarray, way: np.ndarray = way) -> tuple[np.ndarray, np.ndarray]:
            along_mm = speed_mm_s * t - 60
            return 100 + along_mm * way[0], 100 + along_mm * way[1]

        stage.lay("fingertip", start_s, start_s + seconds, path, land_s=1e-3)
    result = score(stage, play(stage, instrument, seed=3))
    assert (result.found, result.missed, result.ghosts, result.split) == (5, 0, 0, 0)


@pytest.mark.parametrize(
    ("name", "seed"),
    [*itertools.product(["two", "cross", "five"], [11, 12]), ("five", 1740005), ("five", 1740007)],
)
def test_several_fingers_are_found_and_none_is_lost_while_others_come(
    name: str, seed: int, instrument: Instrument
) -> None:
    result, _ = scene(name, instrument, seed)
    print(f"{name} {seed}: {result.found} of {result.touches}, {result.split} split")
    assert (result.missed, result.ghosts, result.split) == (0, 0, 0)


@pytest.mark.parametrize(
    ("name", "finger"),
    [*itertools.product(["tap", "hold", "swipe", "keypad"], ["fingertip", "thumb", "child"]), ("two", "fingertip")],
)
def test_real_fingers(name: str, finger: str, interpolated: Interpolated) -> None:
    """A finger whose face gives way to the wave is one finger: each touch found once, none split, no ghost."""
    stage = stage_scene(name, DEFAULT_PLATE, seed=13, finger=finger)
    result = score(stage, play(stage, interpolated, 13))
    error_mm = np.linalg.norm(result.error_mm, axis=1)
    print(f"{name} {finger}: {result.found} of {result.touches}, median {np.median(error_mm):.3f} mm")
    assert (result.missed, result.ghosts, result.split) == (0, 0, 0)
    assert np.median(error_mm) < 0.4


@pytest.mark.parametrize("seed", [2, 3, 7])
def test_a_first_frame_like_no_other(seed: int, instrument: Instrument, atlas_model: Model) -> None:
    """Two fingers are soon found though they came while a frame was measured: its search is given up for a new one."""
    rng = np.random.default_rng(seed)
    two = [Contact(60.0, 70.0, 60.0, "fingertip"), Contact(150.0, 130.0, 60.0, "fingertip")]
    passing = [Contact(float(x), float(y), 60.0, "fingertip") for x, y in rng.uniform(30.0, 170.0, (4, 2))]
    (untouched,), (rest, other) = (
        instrument.untouched([REFERENCE_C]),
        instrument.change([two, passing], [REFERENCE_C] * 2),
    )
    to_counts = 20000.0 / np.abs(untouched).max()
    pipeline, downs = Pipeline(instrument.acquisition, atlas_model, Settings()), list[int]()
    for number in range(112):
        change = 0.0 if number < 100 else 0.6 * rest + 0.5 * other if number == 100 else rest
        frame = to_counts * (untouched + change) + rng.normal(0.0, 3.0, untouched.shape)
        t_ns = number * 8_000_000
        result = pipeline.process(Frame(np.rint(frame).astype(np.int16), number, t_ns, t_ns + 1_000_000))
        downs += [number for contact in result.contacts if contact.phase == "down"]
    assert len(downs) == 2
    assert max(downs) <= 108


@pytest.mark.parametrize(("finger", "fingers", "right", "median_mm"), [
    ("fingertip", 1, 0.98, 0.10), ("thumb", 1, 0.96, 0.20), ("child", 1, 0.98, 0.10), ("fingertip", 2, 0.96, 0.20),
])  # fmt: skip
def test_single_real_frames(finger: str, fingers: int, right: float, median_mm: float, instrument: Instrument) -> None:
    """In single frames fingers of any size are counted right, and placed to tenths of a millimetre."""
    frames = touched_frames(
        simulate_touches(60, seed=91, instrument=instrument, finger=finger, fingers=fingers, apart_mm=16.0)
    )
    model = Model(default_model_path())
    seen = see(find_with(model, model.atlas, frames), frames)
    count = np.mean([len(one.found) == fingers for one in seen])
    error_mm = [
        min(math.dist((touch.x_mm, touch.y_mm), place) for place in one.true_mm) for one in seen for touch in one.found
    ]
    print(f"{fingers} {finger}: count right {count:.3f}, median {np.median(error_mm):.3f} mm")
    assert count >= right
    assert np.median(error_mm) < median_mm


def test_lost_frames_are_counted(instrument: Instrument) -> None:
    stage = stage_scene("lostframes", DEFAULT_PLATE, seed=11)
    outcome = play(stage, instrument)
    gaps = int(np.diff(stage.sequence).sum() - (len(stage.sequence) - 1))
    assert gaps > 0
    assert outcome.counters.lost == gaps


def test_ten_minutes_of_idle_frames_with_5_k_of_drift_bring_no_ghost(instrument: Instrument) -> None:
    stage = empty_stage(600.0)
    stage.temperature_c = REFERENCE_C + 5.0 * stage.time_s / 600.0
    outcome = play(stage, instrument)
    print(f"{outcome.counters.frames} idle frames, {outcome.counters.inferred} of them opened the gate")
    assert outcome.counters.frames == 75_000
    assert outcome.touches == []
    assert outcome.counters.inferred == 0


@pytest.mark.parametrize("jitter_ns", [1.0, 10.0])
def test_trigger_jitter_raises_the_threshold_instead_of_ghosts(jitter_ns: float, instrument: Instrument) -> None:
    stage = empty_stage(60.0)
    stage.electronics = Electronics(jitter_s=jitter_ns * 1e-9)
    assert play(stage, instrument).touches == []


@pytest.mark.parametrize("place", [(60.0, 140.0), (100.0, 100.0), (150.0, 60.0), (170.0, 170.0)])
def test_a_finger_on_the_plate_at_the_start_is_no_touch_when_it_leaves(
    place: tuple[float, float], instrument: Instrument
) -> None:
    """It is taken for a part of the plate; once it has gone, touches are found as ever."""
    stage = empty_stage(8.0)
    stage.lay("human", -1.0, 3.0, still(*place))
    stage.lay("human", 5.0, 6.0, still(60.0, 60.0), column=1)
    outcome = play(stage, instrument)
    downs = [c for event in outcome.touches for c in event.contacts if c.phase == "down"]
    assert len(downs) == 1, "the touch after it, and nothing else"
    assert np.hypot(downs[0].x_mm - 60.0, downs[0].y_mm - 60.0) < 3.0


def test_a_finger_put_down_while_the_baseline_is_learned_brings_no_ghost(instrument: Instrument) -> None:
    stage = empty_stage(6.0)
    stage.lay("human", 0.1, 1.5, still(80.0, 120.0))
    stage.lay("human", 3.5, 4.5, still(60.0, 60.0), column=1)
    outcome = play(stage, instrument)
    downs = [c for event in outcome.touches for c in event.contacts if c.phase == "down"]
    places = [(round(c.x_mm), round(c.y_mm)) for c in downs]
    assert all(np.hypot(x - 60, y - 60) < 4 or np.hypot(x - 80, y - 120) < 4 for x, y in places), places
    assert any(np.hypot(x - 60, y - 60) < 4 for x, y in places)


def test_what_stays_for_its_time_becomes_part_of_the_plate_and_that_is_reported(instrument: Instrument) -> None:
    settings = Settings.model_validate({"baseline": {"absorb_s": 3.0}})
    stage = empty_stage(12.0)
    stage.lay("human", 1.0, 8.0, still(70.0, 130.0))
    stage.lay("human", 10.0, 11.0, still(120.0, 60.0), column=1)
    outcome = play(stage, instrument, settings=settings)
    phases = [
        (event.frame, c.id, c.phase) for event in outcome.touches for c in event.contacts if c.phase in ("down", "up")
    ]
    assert [(i, phase) for _, i, phase in phases] == [(1, "down"), (1, "up"), (2, "down"), (2, "up")]
    up_s = phases[1][0] / 125.0
    assert up_s == pytest.approx(4.1, abs=0.3), "absorbed after 3 s"
    assert [reason for reason, _ in outcome.notices] == ["absorbed", "lifted"]


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_a_palm_is_not_placed(seed: int, instrument: Instrument) -> None:
    _, outcome = scene("palm", instrument, seed)
    assert outcome.touches == []


@pytest.mark.parametrize("seed", [11, 12])
def test_interference_brings_no_ghost(seed: int, instrument: Instrument) -> None:
    result, _ = scene("interference", instrument, seed)
    print(f"interference {seed}: {result.found} of {result.touches} found")
    assert result.ghosts == 0


@pytest.mark.parametrize("seed", [11, 12])
def test_a_channel_that_dies_brings_no_ghost(seed: int, instrument: Instrument) -> None:
    result, _ = scene("deadchannel", instrument, seed)
    print(f"deadchannel {seed}: {result.found} of {result.touches} found")
    assert result.ghosts == 0


def test_the_shipped_recording_meets_its_promise() -> None:
    """Every touch found once, with one down and one up, no ghost, RMSE at most 3 mm."""
    truth = read(SESSION)
    outcome = replay(SESSION, Settings())
    result = score_stream(truth, outcome.touches)
    rmse_mm = position_scores(result.error_mm)["rmse_mm"]
    print(f"demo: {result.found} of {result.touches}, RMSE {rmse_mm:.2f} mm")
    assert (result.found, result.missed, result.ghosts, result.split) == (6, 0, 0, 0)
    assert result.clean
    assert rmse_mm <= 3.0
    assert all(isinstance(event, TouchEvent) for event in outcome.touches)
