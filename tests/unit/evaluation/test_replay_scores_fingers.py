"""Several fingers at once: each contact belongs to one of them, changes of identity are counted, palms are nobody's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.unit.evaluation.test_replay_scores import FIRST, contact, message, truth
from touchd.evaluation.matching import REACH_MM, scores_by_fingers
from touchd.evaluation.replay_scores import SLACK_FRAMES, score_stream
from touchd.event import TouchEvent
from touchd.recording.data import Recording

Way = NDArray[np.float64]


def strokes(*ways: Way) -> Recording:
    """A recording in which fingers move along ways of shape (n, 2), NaN where they do not touch."""
    recording = truth(*([] for _ in ways), frames=len(ways[0]))
    return replace(recording, contacts_mm=np.stack(ways, axis=1).astype(np.float32))


def followed(*ways: Way) -> list[TouchEvent]:
    """A message a frame, with contact i + 1 along way i where that is not NaN."""
    before: set[int] = set()
    messages = []
    for frame, places in enumerate(zip(*ways, strict=True)):
        down = {i + 1: place for i, place in enumerate(places) if np.isfinite(place[0])}
        ended = [(i, "up", 0.0, 0.0) for i in before - set(down)]
        alive = [(i, "move" if i in before else "down", float(x), float(y)) for i, (x, y) in down.items()]
        if alive or ended:
            messages.append(message(frame, *alive, *ended))  # type: ignore[arg-type]  # pairs
        before = set(down)
    if before:
        messages.append(message(len(ways[0]), *((i, "up", 0.0, 0.0) for i in before)))
    return messages


def line(start: tuple[float, float], stop: tuple[float, float], n: int = 100) -> Way:
    return np.linspace(start, stop, n)


CROSSING = (line((50, 50), (150, 150)), line((150, 62), (50, 138)))


def test_strokes_that_cross_and_keep_their_identities_are_a_clean_sheet() -> None:
    scores = score_stream(strokes(*CROSSING), followed(*CROSSING))
    assert (scores.touches, scores.found, scores.missed, scores.ghosts, scores.split) == (2, 2, 0, 0, 0)
    assert scores.switches == 0
    assert scores.clean
    np.testing.assert_allclose(scores.error_mm, 0, atol=1e-4)
    assert len(scores.error_mm) == 200


def test_contacts_that_go_on_as_each_other_at_the_crossing_switch() -> None:
    """Places are right all the time, so errors are none; only who is who is wrong."""
    swapped = [np.where(np.arange(100)[:, None] < 45, *pair) for pair in (CROSSING, CROSSING[::-1])]
    scores = score_stream(strokes(*CROSSING), followed(*swapped))
    assert scores.switches == 2
    assert (scores.found, scores.missed, scores.ghosts, scores.split) == (2, 0, 0, 0)
    np.testing.assert_allclose(scores.error_mm, 0, atol=1e-4)


def test_a_contact_that_goes_on_as_a_finger_that_lands_nearby_switches_and_that_touch_is_missed() -> None:
    recording = truth([(10, 30, 50, 60)], [(30, 45, 62, 60)])
    events = [message(frame, (1, "move", 50.0 if frame < 30 else 62.0, 60.0)) for frame in range(12, 45)]
    scores = score_stream(recording, events)
    assert (scores.switches, scores.found, scores.missed, scores.ghosts) == (1, 1, 1, 0)


def test_two_fingers_near_each_other_have_a_contact_each_even_if_both_are_nearer_to_one() -> None:
    recording = truth([(10, 40, 50, 60)], [(10, 40, 66, 60)])
    events = contact(1, 12, 41, 51, 60) + contact(2, 12, 41, 57, 60)
    merged = [message(a.frame - FIRST, *[(c.id, c.phase, c.x_mm, c.y_mm) for e in (a, b) for c in e.contacts])
              for a, b in zip(events[:30], events[30:], strict=True)]  # fmt: skip
    scores = score_stream(recording, merged)
    assert (scores.found, scores.missed, scores.ghosts, scores.split, scores.switches) == (2, 0, 0, 0, 0)
    assert sorted(set(scores.error_mm[:, 0].tolist())) == [-9, 1]


def test_a_second_contact_of_one_finger_is_a_ghost() -> None:
    recording = truth([(10, 40, 50, 60)])
    events = [message(frame, (1, "move", 50.0, 60.0), (2, "move", 56.0, 60.0)) for frame in range(12, 40)]
    scores = score_stream(recording, events)
    assert (scores.found, scores.split, scores.ghosts) == (1, 0, 1)


def test_a_contact_that_loses_its_finger_for_a_moment_has_that_in_its_error() -> None:
    recording = truth([(10, 60, 50, 60)])
    far_mm = REACH_MM + 15
    events = [message(frame, (1, "move", 50.0 + (far_mm if 30 <= frame < 35 else 0), 60.0)) for frame in range(12, 60)]
    scores = score_stream(recording, events)
    assert (scores.found, scores.ghosts, scores.switches) == (1, 0, 0)
    assert (scores.error_mm[:, 0] == far_mm).sum() == 5
    assert scores_by_fingers(scores.settled)["1"]["missed"] == 5


def test_while_another_contact_is_its_finger_it_has_no_error() -> None:
    recording = truth([(10, 60, 50, 60)])
    events = [message(frame, (1, "move", 50.0, 60.0)) for frame in range(12, 45)]
    events += [message(frame, (1, "move", 140.0, 60.0), (2, "move", 51.0, 60.0)) for frame in range(45, 60)]
    scores = score_stream(recording, events)
    assert scores.split == 1
    assert sorted(scores.error_mm[:, 0].tolist()) == [0] * 33 + [1] * 15


def test_a_contact_that_was_there_before_the_finger_is_not_it() -> None:
    events = contact(1, 2, 40, 50, 60)
    scores = score_stream(truth([(10, 30, 50, 60)]), events)
    assert (scores.found, scores.missed, scores.ghosts) == (0, 1, 1)


def test_a_contact_that_meets_a_finger_now_and_then_is_a_ghost() -> None:
    """Near it in 20 of 48 messages; with 28 it were the finger, badly placed."""
    for near, ghosts in ((20, 1), (28, 0)):
        places = [50.0 if frame < 12 + near else 150.0 for frame in range(12, 60)]
        events = [message(frame, (1, "move", x_mm, 60.0)) for frame, x_mm in zip(range(12, 60), places, strict=True)]
        scores = score_stream(truth([(10, 60, 50, 60)]), events)
        assert (scores.ghosts, scores.found) == (ghosts, 1 - ghosts)


def test_every_change_of_identity_counts() -> None:
    """To the other finger, back, and there again."""
    recording = truth([(0, 100, 50, 60)], [(0, 100, 120, 60)])
    places = [50.0 if frame // 20 % 2 == 0 else 120.0 for frame in range(80)]
    events = [message(frame, (1, "move", x_mm, 60.0)) for frame, x_mm in enumerate(places)]
    assert score_stream(recording, events).switches == 3


@given(st.integers(1, 4), st.integers(0, 2**31))
def test_small_errors_change_neither_identities_nor_counts(fingers: int, seed: int) -> None:
    """Fingers 20 mm apart or more, found within 3 mm: whatever they do, each contact is its finger's."""
    rng = np.random.default_rng(seed)
    ways = []
    for i in range(fingers):
        way = np.array([20.0 + 45 * i, 100.0]) + np.cumsum(rng.uniform(-1, 1, (120, 2)), axis=0).clip(-12, 12)
        way[: rng.integers(0, 30)] = np.nan
        way[rng.integers(60, 120) :] = np.nan
        ways.append(way)
    found = [way + rng.uniform(-2, 2, way.shape) for way in ways]
    scores = score_stream(strokes(*ways), followed(*found))
    assert (scores.touches, scores.found, scores.ghosts, scores.split, scores.switches) == (fingers, fingers, 0, 0, 0)
    assert scores.clean
    expected = np.concatenate([(f - w)[np.isfinite(w[:, 0])] for f, w in zip(found, ways, strict=True)])
    np.testing.assert_allclose(scores.error_mm, expected, atol=1e-4)
    for key, part in scores_by_fingers(scores.settled).items():
        assert part["count_right"] == 1
        assert part["ghosts"] == 0
        assert key == "0" or (part["missed"], part["max_mm"] < 3) == (0, True)


# -- what a subscriber believes, frame by frame ----------------------------------------------------


def test_between_messages_a_subscriber_believes_the_last_one() -> None:
    recording = truth([(10, 90, 50, 60)])
    events = [message(12, (1, "down", 51.0, 60.0)), message(50, (1, "move", 50.0, 62.0)), message(91, (1, "up", 0, 0))]
    scores = scores_by_fingers(score_stream(recording, events).settled)
    assert scores["1"]["n"] == 70, "80 frames but the first 10, in which the contact may still be confirmed"
    assert scores["1"]["rmse_mm"] == pytest.approx(np.sqrt((30 * 1 + 40 * 4) / 70))
    assert scores["0"] == {"n": 10, "count_right": 1.0, "ghosts": 0}


def test_a_finger_of_which_no_message_tells_is_missed_in_every_frame() -> None:
    scores = scores_by_fingers(score_stream(truth([(10, 90, 50, 60)]), []).settled)
    assert (scores["1"]["missed"], scores["1"]["count_right"]) == (70, 0)


def test_frames_just_after_a_finger_landed_or_lifted_are_left_out() -> None:
    recording = truth([(20, 60, 50, 60)], [(40, 80, 150, 60)])
    scores = scores_by_fingers(score_stream(recording, []).settled)
    assert {key: part["n"] for key, part in scores.items()} == {
        "0": 20 + 20 - SLACK_FRAMES, "1": 2 * (20 - SLACK_FRAMES), "2": 20 - SLACK_FRAMES
    }  # fmt: skip


def test_a_contact_that_stays_when_its_finger_has_gone_is_a_ghost_of_every_frame_from_then_on() -> None:
    recording = truth([(10, 40, 50, 60)])
    scores = score_stream(recording, [message(12, (1, "down", 50.0, 60.0))])
    assert scores.ghosts == 0, "as a contact it is the touch's"
    assert scores_by_fingers(scores.settled)["0"]["ghosts"] == 50


def test_what_is_found_on_the_twins_palm_is_a_ghost() -> None:
    palm = truth([(10, 90, 100, 100)])
    simulated = replace(
        palm, meta=palm.meta.model_copy(update={"source": "simulated"}), force_n=np.full((100, 1), np.nan, np.float32)
    )
    events = contact(1, 20, 60, 100, 100)
    assert (score_stream(palm, events).touches, score_stream(palm, events).ghosts) == (1, 0)
    scores = score_stream(simulated, events)
    assert (scores.touches, scores.missed, scores.ghosts) == (0, 0, 1)
    assert len(scores.error_mm) == 0
