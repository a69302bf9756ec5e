"""Scenes and training sets are reproducible recordings with valid truth."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.recording.data import Recording
from touchd.recording.format import read, write
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.scenes.catalogue import default_keys, stage_scene
from touchd.twin.scenes.robot import AREAS_MM2, TouchSet, stage_touches
from touchd.twin.scenes.timeline import line
from touchd.twin.simulate import change_by, simulate_scene, simulate_stage, simulate_touches, stream

Floats = NDArray[np.float64]
SQUARE = Plate(width_mm=200, height_mm=200, thickness_mm=5)


def touching(recording: Recording) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    assert recording.contacts_mm is not None
    return ~np.isnan(recording.contacts_mm[..., 0])


def same(one: Recording, other: Recording) -> bool:
    names = ("frames", "sequence", "timestamp_ns", "contacts_mm", "force_n", "temperature_c")
    return all(np.array_equal(getattr(one, n), getattr(other, n), equal_nan=n[0] in "cf") for n in names)


def test_pinch_has_two_fingers_at_once_and_drop_a_drop(instrument: Instrument) -> None:
    assert (touching(simulate_scene("pinch", instrument=instrument, frames=250)).sum(axis=1) == 2).any()
    drop = simulate_scene("drop", instrument=instrument)
    assert drop.force_n is not None
    on = touching(drop)
    assert on[-1].tolist() == [False, True]
    assert np.isnan(drop.force_n[on[:, 1], 1]).all()
    assert (drop.force_n[on[:, 0], 0] > 0).all()


def test_a_touch_is_seen_where_the_truth_says_so(instrument: Instrument) -> None:
    recording = simulate_scene("tap", seed=5, instrument=instrument)
    on = touching(recording)[:, 0]
    counts = recording.frames.astype(float)
    change = np.sqrt(((counts - counts[:60].mean(axis=0)) ** 2).mean(axis=(1, 2)))
    noise = change[:60].mean()
    assert change[~on].max() < 1.5 * noise
    settled = on & np.roll(on, 4) & np.roll(on, -4)
    assert change[settled].min() > 3 * noise


def test_the_same_seed_gives_the_same_recording_and_another_another(small: Instrument) -> None:
    one, two, three = (simulate_scene("tap", seed=s, frames=200, instrument=small) for s in (4, 4, 5))
    assert same(one, two)
    assert not same(one, three)


def test_noise_and_truth_have_seeds_of_their_own(small: Instrument) -> None:
    plain = simulate_scene("tap", seed=4, frames=200, instrument=small)
    other = simulate_scene("tap", seed=4, frames=200, instrument=small, electronics=Electronics(jitter_s=1e-8))
    np.testing.assert_array_equal(plain.contacts_mm, other.contacts_mm)
    assert not np.array_equal(plain.frames, other.frames)


@pytest.mark.parametrize("block", [1, 7, 500])
def test_how_frames_are_cut_into_blocks_makes_no_difference(small: Instrument, block: int) -> None:
    electronics = Electronics(jitter_s=5e-9)
    stage = stage_scene("tap", small.plate, seed=3, frames=200, electronics=electronics)
    whole = np.concatenate(list(stream(stage, small, 3)))
    np.testing.assert_array_equal(np.concatenate(list(stream(stage, small, 3, block))), whole)


def test_a_code_is_typed_on_the_given_keys(instrument: Instrument) -> None:
    keys = [("A", 50.0, 60.0), ("B", 150.0, 140.0)]
    recording = simulate_stage(stage_scene("keypad", instrument.plate, keys=keys, code="ABA"), instrument, 0)
    on = touching(recording)[:, 0]
    assert recording.contacts_mm is not None
    begins = np.flatnonzero(on & ~np.roll(on, 1))
    places = recording.contacts_mm[begins, 0]
    assert np.abs(places - [[50, 60], [150, 140], [50, 60]]).max() <= 4


def test_a_code_with_an_unknown_key_is_refused(small: Instrument) -> None:
    with pytest.raises(SimulationError, match="'C'"):
        stage_scene("keypad", small.plate, code="12C")


def test_the_default_keys_are_a_telephones() -> None:
    places = {name: (x, y) for name, x, y in default_keys(SQUARE)}
    assert places["5"] == pytest.approx((100, 84))
    assert places["1"] == pytest.approx((68, 52))
    assert places["#"] == pytest.approx((132, 148))


def test_a_circle_is_round_and_a_hold_keeps_growing(instrument: Instrument) -> None:
    circle = simulate_scene("circle", instrument=instrument, frames=250)
    assert circle.contacts_mm is not None
    place = circle.contacts_mm[touching(circle)[:, 0], 0] - 100
    np.testing.assert_allclose(np.hypot(*place.T), 60, atol=0.01)
    hold = simulate_scene("hold", instrument=instrument, frames=750)
    counts = hold.frames.astype(float)
    change = np.sqrt(((counts - counts[:60].mean(axis=0)) ** 2).mean(axis=(1, 2)))
    assert change[650:690].mean() > 1.15 * change[120:160].mean()


def test_the_demo_is_small_and_survives_being_written(instrument: Instrument, tmp_path: Path) -> None:
    demo = simulate_scene("demo", instrument=instrument)
    assert demo.meta.frame_rate_hz == 100
    assert len(demo.frames) == 900
    assert not touching(demo)[:100].any()
    path = tmp_path / "demo.npz"
    write(path, demo)
    assert path.stat().st_size < 2.5e6
    assert same(demo, read(path))


def test_a_training_set_alternates_untouched_frames_and_touches(instrument: Instrument) -> None:
    told: list[int] = []
    stage = stage_touches(TouchSet(300), instrument.plate, 9)
    recording = simulate_stage(stage, instrument, 9, told.append)
    on = touching(recording)
    assert sum(told) == 600
    assert on.shape == (600, 1)
    np.testing.assert_array_equal(on[:, 0], np.arange(600) % 2 == 1)
    np.testing.assert_array_equal(recording.sequence, np.arange(600))
    assert recording.meta.frame_rate_hz == 2
    assert recording.contacts_mm is not None
    assert recording.temperature_c is not None
    assert recording.force_n is not None
    places = recording.contacts_mm[1::2, 0]
    assert places.min() >= 5
    assert places.max() <= 195
    assert np.ptp(places, axis=0).min() > 180
    assert np.abs(recording.temperature_c - REFERENCE_C).max() == pytest.approx(1, abs=1e-5)
    area = 14 * np.sqrt(recording.force_n[1::2, 0])
    assert area.min() >= 12
    assert area.max() <= 28


def test_a_touch_and_its_untouched_frame_differ_by_the_touch(instrument: Instrument) -> None:
    recording = simulate_touches(300, seed=9, instrument=instrument, electronics=Electronics(noise_db=np.inf))
    counts = recording.frames.astype(float)
    touch = np.sqrt(((counts[1::2] - counts[::2]) ** 2).mean(axis=(1, 2)))
    signal = np.sqrt((counts[::2] ** 2).mean())
    level = 20 * np.log10(touch / signal)
    assert -52 < level.min() < level.max() < -25


def test_training_sets_are_reproducible(small: Instrument) -> None:
    one, two, three = (simulate_touches(40, seed=s, instrument=small) for s in (1, 1, 2))
    assert same(one, two)
    assert not same(one, three)


def test_other_plates_work_too() -> None:
    plate = Plate(width_mm=120, height_mm=70, thickness_mm=6, material="aluminium")
    recording = simulate_scene("swipe", instrument=Instrument(plate), frames=250)
    assert recording.meta.plate == plate
    assert np.nanmax(recording.contacts_mm[..., 1]) < 70  # type: ignore[index]  # it is labelled


def test_impossible_scenes_are_refused(small: Instrument) -> None:
    with pytest.raises(SimulationError, match="no scene 'dance'"):
        simulate_scene("dance", instrument=small)
    with pytest.raises(SimulationError, match="too few"):
        simulate_scene("tap", frames=20, instrument=small)
    with pytest.raises(SimulationError, match="rate_hz"):
        stage_scene("tap", small.plate, rate_hz=0)
    with pytest.raises(SimulationError, match="unknown finger"):
        simulate_scene("tap", finger="toe", instrument=small)
    with pytest.raises(SimulationError, match="margin"):
        simulate_touches(10, instrument=small, margin_mm=1.0)
    with pytest.raises(SimulationError, match="0 touches"):
        simulate_touches(0, instrument=small)


def test_even_touches_leave_no_gaps(instrument: Instrument) -> None:
    """Nowhere is the next of 500 touches farther than 1.2 mean distances, up to a corner; at random 2 and more."""
    apart_mm = 194 / math.sqrt(500)
    farthest = []
    for even in (True, False):
        recording = simulate_touches(500, seed=3, instrument=instrument, even=even)
        assert recording.contacts_mm is not None
        places = recording.contacts_mm[1::2, 0]
        assert places.min() >= 3.0
        assert places.max() <= 197.0
        anywhere = np.stack(np.meshgrid(*2 * [np.linspace(8, 192, 93)]), axis=-1).reshape(-1, 1, 2)
        farthest.append(np.linalg.norm(anywhere - places, axis=2).min(axis=1).max() / apart_mm)
    assert farthest[0] < 1.2
    assert farthest[1] > 1.5
    with pytest.raises(SimulationError, match="even"):
        simulate_touches(10, instrument=instrument, even=True, fingers=2)


@pytest.mark.parametrize("finger", ["silicone", "human"])
def test_any_finger_has_a_margin_that_its_contact_fits_into(finger: str, instrument: Instrument) -> None:
    recording = simulate_touches(50, instrument=instrument, finger=finger)
    assert recording.contacts_mm is not None
    place_mm = recording.contacts_mm[1::2, 0]
    low_mm = np.sqrt(AREAS_MM2[finger][1] / np.pi)
    assert place_mm.min() >= low_mm
    assert place_mm.max() <= 200 - low_mm


def test_a_stale_baseline_is_a_plate_that_is_warmer_in_each_touch(instrument: Instrument) -> None:
    fresh, stale = (simulate_touches(5, instrument=instrument, stale_k=k).temperature_c for k in (0.0, 1.5))
    assert fresh is not None
    assert stale is not None
    np.testing.assert_allclose(stale - fresh, [0, 1.5] * 5, atol=1e-5)


def test_a_frame_of_a_moving_finger(instrument: Instrument) -> None:
    """A fast finger is heard at another place in each sample: at the frame's label in its middle.

    Against the change of fingers at rest, moment by moment: to 1 %, where one in the middle misses 4 %.
    """
    plate = instrument.plate
    stage = stage_scene("idle", plate, frames=300)
    stage.lay("silicone", 1.0, 1.4, line((60, 80), (160, 120), 0.4), force_n=2.0)
    at = int(np.flatnonzero(stage.time_s >= 1.2)[0])
    (before,), (contact,), (after,) = stage.touches(at - 1, at + 2)
    speed_mm_s = np.array([after.x_mm - before.x_mm, after.y_mm - before.y_mm]) / (2 / stage.rate_hz)
    assert np.linalg.norm(speed_mm_s) > 400

    def changed(off_s: float) -> Floats:
        x_mm, y_mm = (np.array(contact[:2]) + off_s * speed_mm_s).tolist()
        (change,) = instrument.change([[contact._replace(x_mm=x_mm, y_mm=y_mm)]], [REFERENCE_C])
        return np.asarray(change)

    a = instrument.acquisition
    off_s = (np.arange(a.samples) - (a.samples - 1) / 2) / a.sample_rate_hz
    nodes_s = np.linspace(off_s[0], off_s[-1], 9)
    spline = CubicSpline(nodes_s, np.stack([changed(node_s) for node_s in nodes_s]))
    expected = np.stack([spline(when_s)[:, i] for i, when_s in enumerate(off_s)], axis=-1)
    moving = change_by(stage, instrument, at, [[contact]], np.array([REFERENCE_C]), np.zeros(1))[0]
    size, resting, missed = (np.linalg.norm(each) for each in (expected, changed(0.0) - expected, moving - expected))
    print(f"of {size:.4f} a finger at rest misses {resting:.4f}, a moving one {missed:.4f}")
    assert resting > 0.03 * size
    assert missed < 0.01 * size


def test_a_frame_of_a_resting_finger(instrument: Instrument) -> None:
    """A robot's frame is one of rest, to the bit."""
    stage = stage_touches(TouchSet(20), instrument.plate, 4, None)
    touches, temperature_c = stage.touches(0, 40), stage.temperature_c
    found = change_by(stage, instrument, 0, touches, temperature_c, np.zeros(40))
    np.testing.assert_array_equal(found, instrument.change(touches, temperature_c))
