"""From a recording to features and positions: what is taken, what is refused, and how it is split."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import TOUCHES
from touchd.errors import TrainingError
from touchd.evaluation.dataset import MIN_TOUCHES, Dataset, digest, labels, make_dataset, split, thin
from touchd.frame import Chirp
from touchd.localization.features import Features
from touchd.recording.data import Act, Recording


def truth_of(touches: Recording) -> Any:
    assert touches.contacts_mm is not None
    return touches.contacts_mm.copy()


def test_each_touch_is_taken_with_its_place(dataset: Dataset, touches: Recording) -> None:
    truth = truth_of(touches)[:, 0]
    assert len(dataset) == len(touches.frames) // 2
    np.testing.assert_array_equal(dataset.position_mm, truth[np.isfinite(truth[:, 0])])
    assert dataset.residual.dtype == np.float32


def test_a_residual_is_a_touch_less_the_untouched_frames_on_both_sides(dataset: Dataset, touches: Recording) -> None:
    features = Features("frequency", touches.acquisition)
    row = np.empty(features.size, np.float32)
    for i in (0, 5, 100):
        before, touch, after = touches.frames[2 * i : 2 * i + 3].astype(np.float32)
        features.extract(touch - (before + after) / 2, row)
        np.testing.assert_allclose(dataset.residual[i], row, atol=0.05)


def test_the_noise_is_the_instruments(dataset: Dataset, touches: Recording) -> None:
    """60 dB below the untouched signal, and a little for rounding to counts."""
    signal = touches.frames[::2].astype(np.float64)
    assert dataset.noise == pytest.approx(1e-3 * np.sqrt(np.mean(signal**2)), rel=0.2)


def test_what_a_stretch_and_a_delay_add_is_the_derivative_of_the_untouched_plate(dataset: Dataset) -> None:
    """A delay turns every bin by its frequency, to a quarter of a turn from the bin itself."""
    a = dataset.acquisition
    plain, slope = (
        rows.reshape(len(dataset), a.channels, 2, -1)[:, :, 0]
        + 1j * rows.reshape(len(dataset), a.channels, 2, -1)[:, :, 1]
        for rows in (dataset.untouched, dataset.delay)
    )
    strong = np.abs(plain) > 0.5 * np.abs(plain).max()
    turn = (slope / np.where(plain == 0, 1, plain))[strong]
    assert np.median(turn.imag) == pytest.approx(2 * np.pi * 75e3, rel=0.4)
    assert abs(np.median(turn.real)) < 0.1 * np.median(turn.imag)


def test_the_digest_tells_recordings_apart(touches: Recording) -> None:
    truth = truth_of(touches)
    truth[1] += 1
    frames = touches.frames.copy()
    frames[3, 0, 0] += 1
    digests = {digest(touches), digest(replace(touches, contacts_mm=truth)), digest(replace(touches, frames=frames))}
    assert len(digests) == 3
    assert digest(touches) == digest(replace(touches))


def cut(touches: Recording, keep: slice, truth: Any) -> Recording:
    return replace(
        touches, frames=touches.frames[keep], sequence=touches.sequence[keep],
        timestamp_ns=touches.timestamp_ns[keep], contacts_mm=truth, force_n=None, temperature_c=None,
    )  # fmt: skip


def test_a_recording_without_truth_is_refused(touches: Recording) -> None:
    with pytest.raises(TrainingError, match="contacts_mm"):
        make_dataset(replace(touches, contacts_mm=None))


def test_too_few_touches_are_refused_with_their_number(touches: Recording) -> None:
    keep = slice(0, 2 * MIN_TOUCHES - 2)
    with pytest.raises(TrainingError, match=f"^.*{MIN_TOUCHES - 1} touches.*too few"):
        make_dataset(cut(touches, keep, truth_of(touches)[keep]))


def test_a_chirp_beyond_the_frames_bins_is_refused(touches: Recording) -> None:
    """Of a wrong chirp or sample rate nothing can be learned."""
    chirp = Chirp(start_hz=1e6, stop_hz=2e6)
    wrong = replace(touches, meta=touches.meta.model_copy(update={"chirp": chirp}))
    with pytest.raises(TrainingError, match="no bin of a frame"):
        make_dataset(wrong)


def test_a_recording_without_an_untouched_frame_is_refused(touches: Recording) -> None:
    with pytest.raises(TrainingError, match="untouched"):
        make_dataset(cut(touches, slice(1, None, 2), truth_of(touches)[1::2]))


@pytest.mark.parametrize("place", [(-0.1, 50), (50, 200.5)])
def test_a_touch_outside_the_plate_is_refused_with_its_place(touches: Recording, place: tuple[float, float]) -> None:
    truth = truth_of(touches)
    truth[11, 0] = place
    with pytest.raises(TrainingError, match=r"1 positions lie outside the plate of 200 x 200 mm.*50\.0"):
        make_dataset(replace(touches, contacts_mm=truth))


@pytest.mark.parametrize("name", ["stroke", "palm", "thumb"])
def test_what_is_labelled_roughly_is_left_out(touches: Recording, name: str) -> None:
    """Of a recording with acts the taps of a fingertip count alone, and nothing else is taken for untouched."""
    acts = (Act(name="tap", begin=0, end=20), Act(name=name, begin=20, end=30))
    meta = touches.meta.model_copy(update={"acts": acts})
    _, touched, untouched = labels(replace(touches, meta=meta))
    _, all_touched, all_untouched = labels(touches)
    assert set(all_touched) - set(touched) == {k for k in all_touched if 20 <= k < 30}
    np.testing.assert_array_equal(untouched, all_untouched)


def test_frames_of_several_fingers_are_left_out(touches: Recording) -> None:
    truth = truth_of(touches)
    second = np.full_like(truth, np.nan)
    second[1:21:2] = 30.0
    assert len(make_dataset(replace(touches, contacts_mm=np.concatenate([truth, second], axis=1)))) == TOUCHES - 10


@given(st.integers(0, 5000), st.integers(0, 2**31))
def test_a_split_is_disjoint_complete_and_reproducible(count: int, seed: int) -> None:
    parts = split(count, seed)
    together = np.concatenate([parts.train, parts.validation, parts.test])
    np.testing.assert_array_equal(np.sort(together), np.arange(count))
    np.testing.assert_allclose(
        [len(parts.train), len(parts.validation), len(parts.test)], [0.7 * count, 0.2 * count, 0.1 * count], atol=1
    )
    again = split(count, seed)
    for name in ("train", "validation", "test"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(again, name))


def test_another_seed_splits_otherwise() -> None:
    assert set(split(1000, 1).test.tolist()) != set(split(1000, 2).test.tolist())


@given(st.integers(100, 5000), st.floats(0.05, 1.0), st.floats(0.05, 1.0))
def test_a_share_thins_the_training_part_alone_and_a_larger_one_holds_the_smaller(
    count: int, one: float, two: float
) -> None:
    whole = split(count, 0)
    small, large = (thin(whole, share) for share in sorted((one, two)))
    assert len(small.train) == round(min(one, two) * len(whole.train))
    np.testing.assert_array_equal(large.train[: len(small.train)], small.train)
    for name in ("validation", "test"):
        np.testing.assert_array_equal(getattr(small, name), getattr(whole, name))


@pytest.mark.parametrize("share", [0.0, -0.5, 1.01, float("nan"), 1e-9])
def test_a_share_of_nothing_or_of_more_than_all_is_refused(share: float) -> None:
    with pytest.raises(TrainingError, match="share"):
        thin(split(1000, 0), share)
