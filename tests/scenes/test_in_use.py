"""What befalls a plate while fingers are on it: a reload, a device that was away, frames that come seldom."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from tests.scenes.stages import RATE_HZ, empty_stage, play, score, shipped
from tests.system.soak.interpolated import Interpolated
from touchd.config.schema import Settings
from touchd.event import Contact
from touchd.frame import Frame
from touchd.pipeline import Pipeline
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.scenes.timeline import Stage, still
from touchd.twin.simulate import DEFAULT_PLATE, stream


def contacts_of(
    stage: Stage, instrument: Instrument, befalls: Callable[[Pipeline, int], object] = lambda _pipeline, _frame: None
) -> Iterator[tuple[int, Contact]]:
    """The contacts of all frames, before each of which something may befall the pipeline."""
    pipeline, number = Pipeline(instrument.acquisition, shipped(atlas=True), Settings()), 0
    for block in stream(stage, instrument, 1):
        for counts in block:
            befalls(pipeline, number)
            for contact in pipeline.process(Frame(counts, number, round(stage.time_s[number] * 1e9), 0)).contacts:
                yield number, contact
            number += 1


@pytest.mark.parametrize("name", ["pinch", "five"])
def test_reload(name: str, instrument: Instrument) -> None:
    """A configuration read again under fingers, four times a second, changes nothing.

    Two or more fingers once went up as a palm's, and came down again.
    """
    stage = stage_scene(name, DEFAULT_PLATE, seed=3000900, frames=450)
    plain, reloaded = (
        [
            (frame, one.id, one.phase, one.kind)
            for frame, one in contacts_of(stage, instrument, befalls)
            if one.phase in ("down", "up")
        ]
        for befalls in (
            lambda _pipeline, _frame: None,
            lambda pipeline, frame: frame % 31 or pipeline.configure(Settings(), None),
        )
    )
    assert plain
    assert reloaded == plain


@pytest.mark.parametrize(("rate_hz", "seed"), [(60.0, 3000901), (60.0, 3000902), (40.0, 3000903)])
def test_five_fingers_in_frames_that_come_seldom(rate_hz: float, seed: int, instrument: Instrument) -> None:
    """Some once were missed, or went up as a palm's: the search for them took as many frames as at 125 Hz."""
    stage = stage_scene("five", DEFAULT_PLATE, seed=seed, frames=round(8 * rate_hz), rate_hz=rate_hz)
    outcome = play(stage, instrument)
    found = score(stage, outcome)
    assert found.touches > 20
    assert (found.missed, found.ghosts) == (0, 0)
    assert "palm" not in [one.kind for message in outcome.touches for one in message.contacts if one.phase == "up"]


def test_each_of_five_fingers_close_together_lifts_and_lands_again() -> None:
    """The others stay: while the one that lands was faint they once went up as a palm's, and came down again."""
    stage = empty_stage(13.6, seed=4620000)
    places_mm = np.add([(60, 110), (78, 95), (96, 88), (114, 92), (132, 104)], stage.rng.uniform(-4, 4, (5, 2)))
    starts_s, lift_s, lifts = [2.0 + 0.15 * finger for finger in range(5)], 3.5, 0
    while lift_s < stage.end_s - 1.5:
        finger = lifts % 5
        stage.lay("fingertip", starts_s[finger], lift_s, still(*places_mm[finger]), force_n=0.6, column=finger)
        starts_s[finger] = lift_s + stage.rng.uniform(0.2, 0.4)
        lift_s, lifts = lift_s + stage.rng.uniform(0.5, 0.9), lifts + 1
    for finger, start_s in enumerate(starts_s):
        stage.lay("fingertip", start_s, stage.end_s - 0.5, still(*places_mm[finger]), force_n=0.6, column=finger)
    found = score(stage, play(stage, Interpolated(DEFAULT_PLATE), 4620000))
    assert found.touches == 5 + lifts
    assert (found.missed, found.ghosts, found.split) == (0, 0, 0)


def test_a_thumb_that_presses_firmly_is_no_palm(instrument: Instrument) -> None:
    """Taps of 230 mm^2, there within a frame or two, once went up as a palm's: a desktop undid them."""
    stage = empty_stage(9.0, seed=4622000)
    for start_s in np.arange(1.0, 8.0, 0.7).tolist():
        length_s = float(stage.rng.uniform(0.15, 0.4))
        stage.lay("thumb", start_s, start_s + length_s, still(*stage.rng.uniform(20, 180, 2).tolist()), force_n=1.8)
    outcome = play(stage, instrument)
    found = score(stage, outcome)
    assert (found.touches, found.missed, found.ghosts) == (10, 0, 0)
    assert {one.kind for message in outcome.touches for one in message.contacts if one.phase == "up"} == {"thumb"}


def test_two_thumbs_that_press_firmly_at_once(instrument: Instrument) -> None:
    """Points between them once explained them: a search found neither in time, or one went up as a palm's."""
    stage, starts_s = empty_stage(16.0, seed=5111000), np.arange(1.0, 15.0, 0.7).tolist()
    for start_s in starts_s:
        for column, low_mm in enumerate((20.0, 120.0)):
            place, after_s = stage.rng.uniform((low_mm, 60), (low_mm + 60, 180)).tolist(), stage.rng.uniform(0, 0.008)
            stage.lay("thumb", start_s + after_s, start_s + 0.35, still(*place), force_n=1.6, column=column)
    outcome = play(stage, instrument)
    found = score(stage, outcome)
    assert (found.touches, found.missed, found.ghosts, found.split) == (40, 0, 0, 0)
    assert "palm" not in [one.kind for message in outcome.touches for one in message.contacts if one.phase == "up"]
    downs_s = [one.t_ns * 1e-9 for one in outcome.touches if any(contact.phase == "down" for contact in one.contacts)]
    late_s = [max(down_s for down_s in downs_s if down_s < start_s + 0.35) - start_s for start_s in starts_s]
    assert sum(late > 0.06 for late in late_s) < 3


@pytest.mark.parametrize("pause_s", [0.1, 0.3])
def test_a_device_comes_back_while_somebody_types(pause_s: float, instrument: Instrument) -> None:
    """Two seconds later keys are found, though nobody pauses for long; they once were not until somebody did."""
    stage, starts_s = empty_stage(9.0, seed=3000904), np.arange(1.0, 8.6, 0.12 + pause_s).tolist()
    for start_s in starts_s:
        stage.lay("fingertip", start_s, start_s + 0.12, still(*stage.rng.uniform(20, 180, 2).tolist()), force_n=0.4)
    away = round(2.0 * RATE_HZ)
    found = contacts_of(stage, instrument, lambda pipeline, frame: pipeline.reset() if frame == away else None)
    downs_s = [frame / RATE_HZ for frame, one in found if one.phase == "down"]
    late = [start_s for start_s in starts_s if start_s > 4.1]
    assert len(late) > 9
    assert all(any(0 <= down_s - start_s < 0.15 for down_s in downs_s) for start_s in late)
    assert len(downs_s) <= len(starts_s)


@pytest.mark.parametrize(
    ("rate_hz", "apart_mm", "pause_s"),
    [(125.0, 16.0, -0.012), (125.0, 20.0, -0.024), (125.0, 20.0, 0.0), (125.0, 24.0, 0.012), (60.0, 20.0, 0.016)],
)
def test_two_fingers_type_at_neighbouring_keys(
    rate_hz: float, apart_mm: float, pause_s: float, instrument: Instrument
) -> None:
    """Each press is a contact, also where the next finger lands as the last one lifts, a little before or after.

    The contact of the last key once moved to the next one.
    """
    stage = empty_stage(7.0, seed=3201000, rate_hz=rate_hz)
    start_s, press, rng = 1.0, 0, stage.rng
    keys_mm = np.array([rng.uniform(60, 140, 2), [0, 0]])
    keys_mm[1] = keys_mm[0] + apart_mm * np.array([math.cos(angle := rng.uniform(0, 6.28)), math.sin(angle)])
    while start_s < 6.4:
        end_s = start_s + rng.uniform(0.09, 0.16)
        place_mm = keys_mm[press % 2] + rng.uniform(-0.5, 0.5, 2)
        stage.lay("fingertip", start_s, end_s, still(*place_mm.tolist()), force_n=0.5, column=press % 2)
        start_s, press = end_s + pause_s + rng.uniform(-0.004, 0.004), press + 1
    found = score(stage, play(stage, instrument))
    assert found.touches > 30
    assert found.missed <= 0.04 * found.touches
    assert found.split + found.ghosts == 0


@pytest.mark.parametrize(("rate_hz", "pause_s"), [(125.0, 0.1), (50.0, 0.3)])
def test_the_key_that_was_held_is_pressed_again(rate_hz: float, pause_s: float, instrument: Instrument) -> None:
    """A finger that is there at the start, and then types at its place, is found from its second or third press on.

    While it stayed up for less than twenty frames it once was not at all.
    """
    stage = empty_stage(7.0, seed=3000905, rate_hz=rate_hz)
    place_mm, starts_s = (70.0, 110.0), np.arange(2.0 + pause_s, 6.5, 0.2 + pause_s).tolist()
    stage.lay("fingertip", -1.0, 2.0, still(*place_mm), force_n=0.5)
    for start_s in starts_s:
        stage.lay("fingertip", start_s, start_s + 0.2, still(*place_mm), force_n=0.5)
    downs = [(frame / rate_hz, one) for frame, one in contacts_of(stage, instrument) if one.phase == "down"]
    assert len(starts_s) - 3 <= len(downs) <= len(starts_s)
    assert all(math.dist((one.x_mm, one.y_mm), place_mm) < 2 for _, one in downs)
