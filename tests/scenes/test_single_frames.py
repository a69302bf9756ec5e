"""Each touched frame is shown to the localizer as the daemon would show it, beside the fingers that truly touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from touchd.errors import RecordingValues
from touchd.evaluation.dataset import make_dataset
from touchd.evaluation.matching import match_frames, scores_by_fingers
from touchd.evaluation.model_scores import judge
from touchd.evaluation.single_frames import find_with, network_features, see, touched_frames
from touchd.evaluation.truth import fingers_only
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.touch import Touch
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_scene, simulate_touches


@pytest.fixture(scope="module")
def one(instrument: Instrument) -> Recording:
    return simulate_touches(60, seed=8, instrument=instrument)


@pytest.fixture(scope="module")
def three(instrument: Instrument) -> Recording:
    return simulate_touches(40, seed=8, instrument=instrument, fingers=3, apart_mm=30.0)


def test_baseline(one: Recording) -> None:
    """The baseline of a touch is the mean of the untouched frames beside it."""
    frames = touched_frames(one)
    assert len(frames) == 60
    assert frames.fingers.tolist() == [1] * 60
    counts, baseline, residual = frames.look(10)
    np.testing.assert_array_equal(counts, one.frames[21])
    np.testing.assert_array_equal(baseline, one.frames[[20, 22]].mean(axis=0, dtype=np.float32))
    np.testing.assert_array_equal(residual, counts - baseline)


def test_features(one: Recording, model: Model) -> None:
    """A network gets the features of its training set, bit for bit."""
    data = make_dataset(one, least=1)
    frames = touched_frames(one)
    np.testing.assert_array_equal(network_features(model, frames), data.residual)
    np.testing.assert_array_equal(frames.true_mm[:, 0], data.position_mm)


def test_network(one: Recording, model: Model) -> None:
    """The network places what it places for the daemon."""
    frames = touched_frames(one)
    seen = see(find_with(model, None, frames), frames)
    judged = judge(model, network_features(model, frames), frames.true_mm[:, 0], frames.noise_energy())
    mine = match_frames(seen, reach_mm=np.inf).judged
    np.testing.assert_array_equal(mine.position_mm, judged.position_mm)
    np.testing.assert_array_equal(mine.sigma_mm, judged.sigma_mm)
    np.testing.assert_array_equal(mine.confidence, judged.confidence)
    scores = scores_by_fingers(match_frames(seen))["1"]
    assert scores["count_right"] == 1
    assert scores["median_mm"] < 1.5
    assert scores["force_rank"] > 0.5, "a larger contact changes the signal more"


def test_perfect(three: Recording) -> None:
    """A perfect localizer of several fingers has perfect scores."""
    frames = touched_frames(three)

    def find(i: int) -> Sequence[Touch]:
        return [Touch(float(x), float(y), 0.1, 1.0, 0.5) for x, y in frames.true_mm[i][::-1]]

    scores = scores_by_fingers(match_frames(see(find, frames)))
    assert set(scores) == {"3"}
    perfect = ("count_right", "all_within_1_mm", "told_apart", "within_1_sigma")
    assert [scores["3"][name] for name in perfect] == [1.0] * 4
    assert (scores["3"]["n"], scores["3"]["missed"], scores["3"]["ghosts"], scores["3"]["max_mm"]) == (40, 0, 0, 0)


def test_one_of_three(three: Recording, model: Model) -> None:
    """A localizer of one finger misses the others."""
    frames = touched_frames(three)
    scores = scores_by_fingers(match_frames(see(find_with(model, None, frames), frames)))["3"]
    assert scores["count_right"] == scores["all_within_2_mm"] == scores["told_apart"] == 0
    assert scores["missed"] - scores["ghosts"] == 2 * 40


def test_no_finger(instrument: Instrument) -> None:
    """A palm or a drop of the twin, which has a place without a force, is neither a finger nor an untouched plate."""
    drop = simulate_scene("drop", seed=21, instrument=instrument)
    assert drop.contacts_mm is not None
    frames = touched_frames(drop)
    on = np.isfinite(drop.contacts_mm[..., 0])
    np.testing.assert_array_equal(frames.fingers, on[on.any(axis=1), 0].astype(int))
    assert 0 in frames.fingers.tolist()
    real = replace(drop, meta=drop.meta.model_copy(update={"source": "usb"}))
    assert fingers_only(real) is real, "elsewhere an unknown force says nothing"
    assert fingers_only(replace(drop, force_n=None)).contacts_mm is drop.contacts_mm


def test_ghosts(instrument: Instrument) -> None:
    """Frames without a finger are localized too, and count ghosts."""
    palm = simulate_scene("palm", seed=21, instrument=instrument, frames=200)
    frames = touched_frames(palm)
    scores = scores_by_fingers(match_frames(see(lambda _i: [Touch(100, 100, 1, 1, 1)], frames)))
    assert scores == {"0": {"n": len(frames), "count_right": 0.0, "ghosts": len(frames)}}


@pytest.mark.parametrize("case", ["touched", "untouched", "outside"])
def test_refused(one: Recording, case: str) -> None:
    """A recording without touched or untouched frames, or with touches beside the plate, is refused."""
    assert one.contacts_mm is not None
    contacts_mm = one.contacts_mm.copy()
    if case == "outside":
        contacts_mm[1] = 200.5, 10
    else:
        contacts_mm[:] = 50 if case == "untouched" else np.nan
    with pytest.raises(RecordingValues, match=case):
        touched_frames(replace(one, contacts_mm=contacts_mm))
