"""Sets and scenes of several fingers keep their distances, and what a set is asked for changes that and no more."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.recording.data import Recording
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.contact import face_of
from touchd.twin.physics.finger import force_of
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.scenes.fingers import FIVE_APART_MM, PASS_MM, TWO_APART_MM
from touchd.twin.scenes.robot import AREAS_MM2, MARGIN_MM, TouchSet, stage_touches
from touchd.twin.scenes.timeline import Stage
from touchd.twin.simulate import DEFAULT_PLATE, simulate_touches

Floats = NDArray[np.float64]


def written(asked: TouchSet, seed: int = 7, plate: Plate = DEFAULT_PLATE) -> Stage:
    return stage_touches(asked, plate, seed)


def centres_and_radii(stage: Stage) -> tuple[Floats, Floats]:
    """Of the touched frames, shapes (count, fingers, 2) and (count, fingers)."""
    x_mm, y_mm, area_mm2 = (np.stack(rows, axis=1)[1::2] for rows in list(zip(*stage.laid, strict=True))[2:5])
    return np.stack([x_mm, y_mm], axis=2), np.sqrt(area_mm2 / np.pi)


def distances(place: Floats) -> Floats:
    """Of each two centres, shape (..., pairs)."""
    one, other = np.triu_indices(place.shape[-2], 1)
    return np.asarray(np.linalg.norm(place[..., one, :] - place[..., other, :], axis=-1))


def test_a_set_of_one_finger_is_drawn_as_it_ever_was() -> None:
    """Walk, areas, places: in this order, so that a seed means the same touches in every release."""
    stage = written(TouchSet(40), seed=3)
    (one,) = stage.laid
    rng = np.random.default_rng(np.random.SeedSequence(3).spawn(3)[0])
    walk = np.cumsum(rng.standard_normal(80))
    np.testing.assert_array_equal(stage.temperature_c, REFERENCE_C + walk * (1 / np.abs(walk).max()))
    np.testing.assert_array_equal(one.area_mm2[1::2], rng.uniform(12.0, 28.0, 40))
    place = 5.0 + 190.0 * rng.uniform(size=(40, 2))
    np.testing.assert_array_equal(np.stack([one.x_mm, one.y_mm], axis=1)[1::2], place)
    assert np.isnan(one.x_mm[::2]).all()


@given(
    fingers=st.integers(1, 5),
    apart_mm=st.floats(0, 30),
    finger=st.sampled_from(["silicone", "human", "fingertip", "glove"]),
    seed=st.integers(0, 2**31),
)
def test_fingers_keep_their_distance_lie_on_the_plate_and_cover_none_other(
    fingers: int, apart_mm: float, finger: str, seed: int
) -> None:
    stage = written(TouchSet(20, finger, fingers=fingers, apart_mm=apart_mm), seed)
    place, radius = centres_and_radii(stage)
    assert place.shape == (20, fingers, 2)
    one, other = np.triu_indices(fingers, 1)
    assert (distances(place) >= np.maximum(apart_mm, radius[:, one] + radius[:, other])).all()
    assert ((place >= MARGIN_MM[finger]) & (place <= 200 - MARGIN_MM[finger])).all()
    low, high = AREAS_MM2[finger]
    area = np.stack([one.area_mm2 for one in stage.laid], axis=1)[1::2]
    assert ((area >= low) & (area <= high)).all()
    contacts_mm, force_n = stage.truth()
    assert contacts_mm.shape == (40, fingers, 2)
    assert np.isnan(contacts_mm[::2]).all()
    np.testing.assert_allclose(force_n[1::2], force_of(finger, area), rtol=1e-6)


@pytest.mark.parametrize("finger", ["fingertip", "thumb", "glove"])
def test_a_turned_face_lies_on_the_plate(finger: str) -> None:
    """However large, long and turned: one of 8,000 fingertips reached over the edge, and its session failed."""
    small = Plate(width_mm=21, height_mm=21, thickness_mm=5)
    faces = [face_of(one) for [one] in written(TouchSet(5000, finger), plate=small).touches(0, 10_000)[1::2]]
    centres_mm = np.array([face.centres_mm for face in faces])
    radius_mm = np.sqrt([face.disc_mm2 / np.pi for face in faces])[:, None, None] - 1e-9
    assert ((centres_mm >= radius_mm) & (centres_mm <= 21 - radius_mm)).all()


@pytest.mark.parametrize(
    ("asked", "where"),
    [
        (TouchSet(10, fingers=5, apart_mm=150.0), "apart"),
        (TouchSet(10, fingers=0), "fingers"),
        (TouchSet(10, fingers=6), "fingers"),
        (TouchSet(10, fingers=2, apart_mm=-1.0), "apart"),
        (TouchSet(10, fingers=2, apart_mm=float("nan")), "apart"),
        (TouchSet(10, label_noise_mm=-0.1), "label_noise"),
    ],
)
def test_what_cannot_be_laid_is_refused_with_what_to_do(asked: TouchSet, where: str) -> None:
    with pytest.raises(SimulationError) as caught:
        written(asked)
    assert caught.value.where == where
    assert caught.value.fix


@pytest.mark.parametrize("rate_hz", [1e-4, 1e7, float("nan"), -1.0])
def test_rates(rate_hz: float) -> None:
    """A rate is refused of which a scene of 200 frames would last for days, or no device has."""
    with pytest.raises(SimulationError, match="frames a second"):
        stage_scene("tap", DEFAULT_PLATE, frames=200, rate_hz=rate_hz)


def test_as_many_fingers_as_just_fit_are_laid() -> None:
    place, _ = centres_and_radii(written(TouchSet(50, fingers=5, apart_mm=70.0)))
    assert distances(place).min() >= 70.0


def test_a_warmer_session_is_the_same_session_in_another_room(small: Instrument) -> None:
    cold, reference, hot = (simulate_touches(20, seed=2, instrument=small, warmer_k=k) for k in (-10.0, 0.0, 10.0))
    assert reference.temperature_c is not None
    for other, k in ((cold, -10), (hot, 10)):
        assert other.temperature_c is not None
        np.testing.assert_allclose(other.temperature_c - reference.temperature_c, k, atol=1e-5)
        np.testing.assert_array_equal(other.contacts_mm, reference.contacts_mm)
        # 10 K stretch time by 4.5e-4: far more than noise.
        change = (other.frames[::2].astype(float) - reference.frames[::2]).std()
        assert change > 0.02 * reference.frames[::2].astype(float).std()


def test_a_room_that_the_instrument_was_not_made_for_is_refused(small: Instrument) -> None:
    with pytest.raises(SimulationError, match="temperatures beyond"):
        simulate_touches(5, instrument=small, warmer_k=40.0)


def test_label_noise_is_gaussian_of_its_size_and_touches_neither_frames_nor_forces(small: Instrument) -> None:
    plain, noisy = (simulate_touches(400, seed=2, instrument=small, label_noise_mm=s) for s in (0.0, 0.3))
    np.testing.assert_array_equal(plain.frames, noisy.frames)
    np.testing.assert_array_equal(plain.force_n, noisy.force_n)
    assert plain.contacts_mm is not None
    assert noisy.contacts_mm is not None
    np.testing.assert_array_equal(np.isnan(plain.contacts_mm), np.isnan(noisy.contacts_mm))
    error = (noisy.contacts_mm - plain.contacts_mm)[1::2, 0]
    np.testing.assert_allclose(error.std(axis=0), 0.3, rtol=0.15)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.05)
    assert np.median(np.abs(error)) == pytest.approx(0.6745 * 0.3, rel=0.15)


def test_labels_stay_on_the_plate_however_noisy() -> None:
    contacts_mm, _ = written(TouchSet(2000, label_noise_mm=20.0)).truth()
    assert np.nanmin(contacts_mm) == 0
    assert np.nanmax(contacts_mm) == 200


def test_two_fingers_sound_like_more_than_either(instrument: Instrument) -> None:
    """Far apart they scatter little into each other: the change is nearly the sum of both."""
    quiet = Electronics(noise_db=np.inf)
    both = simulate_touches(30, seed=5, instrument=instrument, electronics=quiet, fingers=2, apart_mm=60.0)
    assert both.contacts_mm is not None
    stage = stage_touches(TouchSet(30, fingers=2, apart_mm=60.0), instrument.plate, 5, quiet)
    touches, temperature_c = stage.touches(0, 60)[1::2], stage.temperature_c[1::2]
    together = instrument.change(touches, temperature_c)
    alone = sum(instrument.change([[touch[i]] for touch in touches], temperature_c) for i in (0, 1))
    assert np.linalg.norm(together - alone) < 0.15 * np.linalg.norm(together)
    heard = (both.frames[1::2].astype(float) - both.frames[::2]).std(axis=(1, 2))
    assert np.corrcoef(heard, together.std(axis=(1, 2)))[0, 1] > 0.95


# -- scenes ---------------------------------------------------------------------------------------


def truth_of(name: str, seed: int, **options: int) -> tuple[Stage, Floats]:
    stage = stage_scene(name, DEFAULT_PLATE, seed=seed, **options)  # type: ignore[arg-type]  # keywords
    return stage, stage.truth()[0].astype(float)


def touches_of(contacts_mm: Floats) -> list[NDArray[np.int64]]:
    """Frames of each touch of each finger."""
    runs = []
    for finger in range(contacts_mm.shape[1]):
        frames = np.flatnonzero(np.isfinite(contacts_mm[:, finger, 0]))
        runs += np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    return runs


@pytest.mark.parametrize(("name", "fingers", "apart_mm"), [("two", 2, TWO_APART_MM), ("five", 5, FIVE_APART_MM)])
@pytest.mark.parametrize("seed", range(4))
def test_fingers_press_slide_and_lift_independently(name: str, fingers: int, apart_mm: float, seed: int) -> None:
    _, contacts_mm = truth_of(name, seed)
    assert contacts_mm.shape[1] == fingers
    assert np.nanmin(distances(contacts_mm)) >= apart_mm - 1e-4
    down = np.isfinite(contacts_mm[..., 0])
    counts = down.sum(axis=1)
    assert set(range(fingers + 1)) == set(counts.tolist()), "every number of fingers from none to all"
    for one, other in itertools.combinations(range(fingers), 2):
        assert (down[:, one] & ~down[:, other]).any()
        assert (down[:, other] & ~down[:, one]).any()
    lengths = [np.linalg.norm(np.ptp(contacts_mm[frames], axis=0)[finger]) for finger in range(fingers)
               for frames in touches_of(contacts_mm[:, [finger]])]  # fmt: skip
    assert min(lengths) == 0
    assert max(lengths) > 25


@pytest.mark.parametrize("seed", range(4))
def test_strokes_cross_and_pass_each_other_at_their_distance(seed: int) -> None:
    stage, contacts_mm = truth_of("cross", seed)
    apart = distances(contacts_mm)[:, 0]
    assert np.nanmin(apart) >= PASS_MM - 1e-4
    starts = [run[0] for run in touches_of(contacts_mm[:, [0]])]
    assert len(starts) >= 3
    for start, after in itertools.pairwise([*starts, len(stage.sequence)]):
        assert np.nanmin(apart[start:after]) < PASS_MM + 1, "in every pass"
        one, other = (contacts_mm[start:after, i][np.isfinite(contacts_mm[start:after, i, 0])] for i in (0, 1))
        assert crosses(one[0], one[-1], other[0], other[-1])


def crosses(a: Floats, b: Floats, c: Floats, d: Floats) -> bool:
    """Whether the segments ab and cd have a point in common."""

    def side(p: Floats, q: Floats, r: Floats) -> bool:
        return bool((q[0] - p[0]) * (r[1] - p[1]) > (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) != side(a, b, d) and side(c, d, a) != side(c, d, b)


@pytest.mark.parametrize("seed", range(3))
def test_a_long_hold_lasts_half_a_minute_while_the_plate_warms_by_a_kelvin(seed: int) -> None:
    stage, contacts_mm = truth_of("longhold", seed)
    (held,) = touches_of(contacts_mm)
    assert len(held) / stage.rate_hz >= 30
    assert np.ptp(contacts_mm[held], axis=0).max() == 0
    assert stage.temperature_c[held[-1]] - stage.temperature_c[held[0]] == pytest.approx(1, abs=0.45)
    assert stage.laid[0].area_mm2[held[-20]] > 1.4 * stage.laid[0].area_mm2[held[20]]


@pytest.mark.parametrize("name", ["two", "five", "cross", "palm"])
def test_a_plate_without_room_for_a_scene_is_refused(name: str) -> None:
    with pytest.raises(SimulationError, match="too small"):
        stage_scene(name, Plate(width_mm=200, height_mm=70))


@pytest.mark.parametrize(("name", "side_mm"), [("two", 80), ("five", 150), ("cross", 80)])
@pytest.mark.parametrize("seed", range(5))
def test_on_the_smallest_plate_every_contact_lies_on_it(name: str, side_mm: float, seed: int) -> None:
    stage = stage_scene(name, Plate(width_mm=side_mm, height_mm=side_mm), seed=seed)
    for _, _, x, y, area, *_ in stage.laid:
        on = np.isfinite(x)
        edge = np.minimum(np.minimum(x, side_mm - x), np.minimum(y, side_mm - y))[on]
        assert (edge >= np.sqrt(area[on] / np.pi)).all()


def test_scenes_of_several_fingers_are_reproducible() -> None:
    (_, one), (_, two), (_, three) = (truth_of("five", seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, three, equal_nan=True)


def test_a_recording_of_several_fingers_has_a_column_each(small: Instrument) -> None:
    recording: Recording = simulate_touches(12, seed=1, instrument=small, fingers=3, apart_mm=20.0)
    assert recording.contacts_mm is not None
    assert recording.contacts_mm.shape == (24, 3, 2)
    assert "3 silicone fingers" in recording.meta.notes


def test_oval() -> None:
    """A fingertip lands round and small, rolls to its pad, and rests as an oval that turns by a few degrees at most."""
    stage = stage_scene("hold", DEFAULT_PLATE, seed=5, finger="fingertip", rate_hz=250.0)
    down = np.flatnonzero(~np.isnan(stage.laid[0].x_mm))
    x, y, area, _, ratio, angle = (row[down] for row in stage.laid[0][2:])
    assert ratio[0] < 1.05
    assert 1.1 < ratio[len(ratio) // 2] < 1.5
    assert area[0] < 5
    assert 50 < area[len(area) // 2] < 110
    assert np.ptp(angle) < 0.11
    rolled = np.hypot(x - x[len(x) // 2], y - y[len(y) // 2])
    assert 0.05 < rolled[0] < 1.5
    assert rolled[20:-20].max() < 1e-9
    contact = stage.touches(down[400], down[400] + 1)[0][0]
    assert contact == (x[400], y[400], area[400], "fingertip", ratio[400], angle[400])
