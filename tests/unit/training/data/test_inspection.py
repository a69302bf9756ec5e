"""What is wrong with a recording is said before training, in a sentence that names it; a good one raises no word."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.errors import TrainingError
from touchd.evaluation.dataset import PAUSE_S, baseline_frames, make_dataset
from touchd.frame import Chirp, Plate
from touchd.recording.data import Act, Recording
from touchd.training.data.inspection import coverage, density, inspect
from touchd.training.data.join import join

PLATE = Plate(width_mm=200, height_mm=200)
Change = Callable[[np.ndarray, np.ndarray], None]


def truth_of(touches: Recording) -> Any:
    assert touches.contacts_mm is not None
    return touches.contacts_mm.copy()


def changed(touches: Recording, change: Change) -> list[str]:
    """What is said once frames or truth are changed, less what is said of the recording as it is."""
    frames, truth = touches.frames.copy(), truth_of(touches)
    change(frames, truth)
    return [
        note
        for note in inspect(replace(touches, frames=frames, contacts_mm=truth))
        if note not in inspect(touches)
    ]  # fmt: skip


def test_of_a_good_recording_only_its_part_of_the_plate_is_told(touches: Recording) -> None:
    """The twin's robot touched the middle alone, densely."""
    assert len(inspect(touches)) == 1
    assert "x 70..130, y 70..130 mm, 9 % of the plate" in inspect(touches)[0]


def flat(frames: np.ndarray, _truth: np.ndarray) -> None:
    frames[:, 2] = 17


def deaf(frames: np.ndarray, _truth: np.ndarray) -> None:
    frames[:, 1] = np.random.default_rng(0).normal(0, 20, frames[:, 1].shape)


def faint(frames: np.ndarray, _truth: np.ndarray) -> None:
    frames[:, 3] = frames[:, 3] / 100


def clipped(frames: np.ndarray, _truth: np.ndarray) -> None:
    frames[:] = np.clip(frames.astype(np.int32) * 3, -32768, 32767)


def other_gain(frames: np.ndarray, _truth: np.ndarray) -> None:
    frames[400:] = frames[400:] * 0.9


def other_channel(frames: np.ndarray, _truth: np.ndarray) -> None:
    frames[301:, 0] = np.roll(frames[301:, 0], 3, axis=1)


def without_finger(frames: np.ndarray, _truth: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    for i in (5, 101):
        # The same plate with fresh noise, as the robot would record it when it misses.
        frames[i] = frames[i - 1] + np.round(rng.normal(0, 2, frames[i].shape))


def twice(frames: np.ndarray, _truth: np.ndarray) -> None:
    frames[101:111:2] = frames[1:11:2]


def on_a_raster(_frames: np.ndarray, truth: np.ndarray) -> None:
    truth[:] = np.round(truth / 10) * 10


def with_a_hole(_frames: np.ndarray, truth: np.ndarray) -> None:
    at = np.isfinite(truth[:, 0, 0]) & (np.abs(truth[:, 0] - 100) < 12).all(axis=1)
    truth[at, 0, 0] -= 25


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (flat, "channel 3 is dead: always 17 counts"),
        (deaf, "channel 2 is dead: it hears noise only"),
        (faint, r"channel 4 hears \d\d dB less than the others"),
        (clipped, r"the converter clips in \d+\.\d % of the frames \(channel"),
        (other_gain, "the untouched plate changes by 1[01] % at once between frames 39[89] and 40[01]"),
        (other_channel, r"the untouched plate changes by \d+ % at once between frames 30[01] and 30[23]"),
        (without_finger, "2 touches do not exceed the noise, the first in frame 5"),
        (twice, "5 touches are exact copies"),
        (on_a_raster, r"\d+ of 400 touches share their position with another"),
        (
            with_a_hole,
            r"of 49 equal parts of the touched rectangle contain no touch, one about \((9|10)\d, (9|10)\d\) mm",
        ),
    ],
)
def test_what_is_wrong_is_named(change: Change, says: str, touches: Recording) -> None:
    notes = changed(touches, change)
    assert any(re.search(says, note) for note in notes), notes


def test_a_recording_in_which_no_channel_hears_the_chirp_is_refused(touches: Recording) -> None:
    noise = np.random.default_rng(0).normal(0, 20, touches.frames.shape).astype(np.int16)
    with pytest.raises(TrainingError, match="none of the 4 channels hears the chirp"):
        inspect(replace(touches, frames=noise))


def test_touches_held_over_many_frames_are_no_independent_ones(touches: Recording) -> None:
    """As of a stream: of ten frames each, the test would know nine."""
    truth = truth_of(touches)
    for first in range(0, len(truth), 10):
        truth[first : first + 8] = truth[first + 1]
        truth[first + 8 : first + 10] = np.nan
    assert any("continue from the frame before" in note for note in inspect(replace(touches, contacts_mm=truth)))


def test_a_touch_far_from_any_untouched_frame_is_named_with_its_distance(touches: Recording) -> None:
    time_ns = touches.timestamp_ns.copy()
    time_ns[199:] += 40_000_000_000
    time_ns[200:] += 45_000_000_000
    notes = inspect(replace(touches, timestamp_ns=time_ns))
    assert any("1 touches are more than 30 s from any untouched frame, up to 40 s" in note for note in notes), notes


@given(st.integers(100, 4000), st.integers(0, 100))
def test_few_touches_are_called_few_and_enough_are_not(count: int, seed: int) -> None:
    """1,000-1,750 for the reference plate, by its size and the waves on it."""
    position_mm = np.random.default_rng(seed).uniform(0, 200, (count, 2)).astype(np.float32)
    notes = list(density(position_mm, PLATE, Chirp().stop_hz, 0.7))
    assert bool(notes) == (0.7 * count < 1340) or 1200 < 0.7 * count < 1400


@given(st.integers(100, 6000), st.integers(0, 100))
def test_touches_all_over_the_plate_have_no_hole(count: int, seed: int) -> None:
    position_mm = np.random.default_rng(seed).uniform(0, 200, (count, 2)).astype(np.float32)
    holes = [note for note in coverage(position_mm, PLATE) if "of the touched rectangle" in note]
    assert len(holes) == 0 or holes[0].startswith("1 of"), "by chance"


@given(st.lists(st.integers(1, 60), min_size=3, max_size=40), st.data())
def test_a_touch_is_compared_with_the_untouched_frames_beside_it_but_not_across_a_pause(
    gaps_s: list[int], data: st.DataObject
) -> None:
    time_ns = np.cumsum(gaps_s) * 1_000_000_000
    down = np.array(data.draw(st.lists(st.booleans(), min_size=len(gaps_s), max_size=len(gaps_s))))
    down[data.draw(st.integers(0, len(down) - 1))] = False
    touched, untouched = np.flatnonzero(down), np.flatnonzero(~down)
    for i, pair in zip(touched, baseline_frames(time_ns, touched, untouched), strict=True):
        before, after = untouched[untouched < i][-1:], untouched[untouched > i][:1]
        beside = [*before, *after]
        assert set(pair) <= set(beside)
        apart_s = [abs(int(time_ns[i] - time_ns[j])) * 1e-9 for j in beside]
        if len(beside) == 2 and max(apart_s) <= PAUSE_S:
            assert set(pair) == set(beside)
        assert beside[int(np.argmin(apart_s))] in pair


def half(touches: Recording, keep: slice) -> Recording:
    cut = {name: getattr(touches, name)[keep] for name in ("frames", "sequence", "timestamp_ns", "contacts_mm")}
    return replace(touches, **cut, force_n=None, temperature_c=None)


def test_joined_recordings_hold_the_touches_of_all_each_with_its_own_untouched_plate(touches: Recording) -> None:
    one, two = half(touches, slice(0, 301)), half(touches, slice(301, 800))
    both, apart = make_dataset(join([one, two], ["a", "b"])), [make_dataset(part) for part in (one, two)]
    np.testing.assert_array_equal(both.position_mm, np.concatenate([part.position_mm for part in apart]))
    np.testing.assert_array_equal(both.residual, np.concatenate([part.residual for part in apart]))


@pytest.mark.parametrize("thickness_mm", [0.001, 0.05, 60.0, 1e4])
def test_a_plate_of_an_impossible_thickness(thickness_mm: float, touches: Recording) -> None:
    """It is refused with the key, not after minutes that make a model of nothing."""
    plate = touches.meta.plate.model_copy(update={"thickness_mm": thickness_mm})
    wrong = replace(touches, meta=touches.meta.model_copy(update={"plate": plate}))
    with pytest.raises(
        TrainingError, match=rf"^a\.npz: meta\.plate\.thickness_mm: {thickness_mm:g} mm is no thickness"
    ):
        join([wrong], ["a.npz"])


def test_acts_of_joined_recordings_keep_their_frames(touches: Recording) -> None:
    """The acts of the second recording lie behind the frames of the first."""
    acts = (Act(name="palm", begin=5, end=9),)
    labelled = replace(touches, meta=touches.meta.model_copy(update={"acts": acts}))
    both = join([touches, labelled], ["a", "b"])
    n = len(touches.frames)
    assert np.flatnonzero(both.during("palm")).tolist() == list(range(n + 5, n + 9))


def test_a_recording_of_two_fingers_joins_one_of_one(touches: Recording) -> None:
    wide = np.concatenate([truth_of(touches), np.full_like(truth_of(touches), np.nan)], axis=1)
    both = join([touches, replace(touches, contacts_mm=wide, force_n=None)], ["a", "b"])
    assert both.contacts_mm is not None
    assert both.contacts_mm.shape == (1600, 2, 2)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"sample_rate_hz": 200e3}, "sample_rate_hz is 250000.0 in a.npz, but 200000.0 here"),
        ({"chirp": Chirp(stop_hz=90e3)}, "chirp is .*100000.0.* in a.npz, but .*90000.0"),
        ({"plate": Plate(width_mm=300, height_mm=200)}, "plate is 200 x 200 x 5 mm of glass in a.npz, but 300 x 200"),
        ({"emitter_mm": (1.0, 2.0)}, r"emitter_mm is \(30.0, 100.0\) in a.npz, but \(1.0, 2.0\)"),
    ],
)
def test_mixed_acquisitions_are_refused_with_both_named(change: dict[str, Any], says: str, touches: Recording) -> None:
    other = replace(touches, meta=touches.meta.model_copy(update=change))
    with pytest.raises(TrainingError, match=rf"b\.npz: mixed acquisitions: {says}"):
        join([touches, other], ["a.npz", "b.npz"])


def test_recordings_of_other_channels_are_refused_with_both_numbers(touches: Recording) -> None:
    meta = touches.meta.model_copy(update={"receivers_mm": None})
    other = replace(touches, meta=meta, frames=touches.frames[:, :3].copy())
    with pytest.raises(TrainingError, match=r"channels is 4 in a\.npz, but 3 here"):
        join([touches, other], ["a.npz", str(Path("b.npz"))])
