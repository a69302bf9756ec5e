"""Which touches a replay found, missed, invented or split, on truth and events made by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from touchd.evaluation.matching import REACH_MM
from touchd.evaluation.replay_scores import SLACK_FRAMES, found_contacts, score_stream
from touchd.evaluation.truth import true_touches
from touchd.event import Contact, Phase, TouchEvent
from touchd.frame import Plate
from touchd.recording.data import Act, Meta, Recording

META = Meta(sample_rate_hz=250e3, bits=16, full_scale_v=10, frame_rate_hz=125, plate=Plate(width_mm=200, height_mm=200))
FIRST = 1000
"""Sequence numbers need not begin with 0."""

Touch = tuple[int, int, float, float]
"""From this frame to the one before that, at x and y."""


def truth(*fingers: Sequence[Touch], frames: int = 100) -> Recording:
    """A recording in which each finger touches now and then."""
    contacts_mm = np.full((frames, max(1, len(fingers)), 2), np.nan, np.float32)
    for column, touches in enumerate(fingers):
        for start, stop, x_mm, y_mm in touches:
            contacts_mm[start:stop, column] = x_mm, y_mm
    numbers = np.arange(frames)
    return Recording(META, np.zeros((frames, 1, 1), np.int16), FIRST + numbers, numbers * 8_000_000, contacts_mm)


def message(frame: int, *contacts: tuple[int, Phase, float, float]) -> TouchEvent:
    made = [Contact(i, phase, x_mm, y_mm, 0.5, 1.0, 1.0, 0.0, 0.0) for i, phase, x_mm, y_mm in contacts]
    return TouchEvent("plate", frame, frame, "", FIRST + frame, made)


def contact(i: int, start: int, stop: int, x_mm: float, y_mm: float) -> list[TouchEvent]:
    """The messages of a contact that goes down, stays and comes up."""
    holds = [message(frame, (i, "hold", x_mm, y_mm)) for frame in range(start + 1, stop)]
    return [message(start, (i, "down", x_mm, y_mm)), *holds, message(stop, (i, "up", x_mm, y_mm))]


TWO = truth([(10, 30, 50, 60), (50, 70, 150, 100)])


def test_touches_are_runs_of_frames_of_one_finger_in_order_of_time() -> None:
    touches = true_touches(truth([(40, 45, 1, 2), (60, 61, 3, 4)], [(5, 50, 7, 8)]))
    assert [(int(t.frames[0]) - FIRST, len(t.frames), *t.position_mm[0]) for t in touches] == [
        (5, 45, 7, 8),
        (40, 5, 1, 2),
        (60, 1, 3, 4),
    ]
    assert true_touches(truth()) == []


def test_each_touch_found_once_is_a_clean_sheet() -> None:
    scores = score_stream(TWO, contact(1, 12, 32, 51, 60) + contact(2, 52, 72, 150, 98))
    assert (scores.touches, scores.found, scores.missed, scores.ghosts, scores.split) == (2, 2, 0, 0, 0)
    assert scores.clean
    np.testing.assert_allclose(scores.error_mm, [[1, 0]] * 18 + [[0, -2]] * 18)


def test_a_touch_without_a_contact_is_missed() -> None:
    scores = score_stream(TWO, contact(1, 12, 32, 50, 60))
    assert (scores.found, scores.missed, scores.ghosts) == (1, 1, 0)


def test_nothing_found_leaves_nothing_to_score() -> None:
    scores = score_stream(TWO, [])
    assert (scores.found, scores.missed, scores.error_mm.shape) == (0, 2, (0, 2))


@pytest.mark.parametrize(
    ("start", "x_mm"), [(2, 50), (35 + SLACK_FRAMES, 50), (12, 50 + REACH_MM + 1)], ids=["early", "late", "elsewhere"]
)
def test_a_contact_where_or_when_nobody_touched_is_a_ghost(start: int, x_mm: float) -> None:
    ghost = contact(1, start, start + 4, x_mm, 60)
    scores = score_stream(truth([(10, 30, 50, 60)]), ghost)
    assert (scores.found, scores.missed, scores.ghosts, len(scores.error_mm)) == (0, 1, 1, 0)


def test_a_touch_found_in_two_pieces_is_split() -> None:
    scores = score_stream(truth([(10, 40, 50, 60)]), contact(1, 12, 20, 50, 60) + contact(2, 24, 41, 50, 60))
    assert (scores.found, scores.split, scores.ghosts) == (1, 1, 0)


def test_of_two_fingers_at_once_each_contact_belongs_to_the_nearer() -> None:
    recording = truth([(10, 40, 50, 60)], [(10, 40, 70, 60)])
    events = [
        message(12, (1, "down", 69.0, 60), (2, "down", 52.0, 60)),
        message(20, (1, "hold", 69.0, 60), (2, "hold", 52.0, 60)),
        message(42, (1, "up", 69.0, 60), (2, "up", 52.0, 60)),
    ]
    scores = score_stream(recording, events)
    assert (scores.found, scores.split, scores.ghosts) == (2, 0, 0)
    assert sorted(scores.error_mm[:, 0].tolist()) == [-1, -1, 2, 2]


@pytest.mark.parametrize("phases", [["down"], ["down", "down", "up"], ["down", "up", "up"], ["hold", "up"]])
def test_a_contact_without_exactly_one_down_and_one_up_is_not_clean(phases: list[Phase]) -> None:
    events = [message(12 + n, (1, phase, 50.0, 60.0)) for n, phase in enumerate(phases)]
    assert not score_stream(TWO, events).clean


def test_the_place_where_a_contact_ended_is_no_position_of_a_finger() -> None:
    (found,) = found_contacts(contact(7, 12, 15, 50, 60))
    assert found.frames == [FIRST + 12, FIRST + 13, FIRST + 14]
    assert (found.downs, found.ups) == (1, 1)


def test_down_latency_is_the_time_from_the_touchs_first_frame_to_the_first_message() -> None:
    scores = score_stream(TWO, contact(1, 12, 30, 50, 60) + contact(2, 56, 70, 150, 100))
    assert scores.down_latency_ms == pytest.approx((16 + 48) / 2)


def test_jitter_is_the_scatter_of_a_still_finger_and_no_constant_error() -> None:
    still = truth([(0, 100, 50, 60)])
    events = [message(frame, (1, "move", 57 + (-1) ** frame, 60)) for frame in range(50)]
    scores = score_stream(still, events)
    assert scores.jitter_mm == pytest.approx(1.0)
    assert not scores.moving.any()


def test_a_moving_finger_has_an_error_but_no_jitter() -> None:
    stroke = truth([(0, 100, 50, 60)])
    assert stroke.contacts_mm is not None
    stroke.contacts_mm[:, 0, 0] = np.linspace(20, 180, 100)
    events = [message(frame, (1, "move", 20 + frame * 160 / 99, 62)) for frame in range(100)]
    scores = score_stream(stroke, events)
    assert scores.moving.all()
    assert scores.jitter_mm is None
    np.testing.assert_allclose(scores.error_mm, [[0, 2]] * 100, atol=1e-4)


def test_without_a_contact_there_is_neither_latency_nor_jitter() -> None:
    scores = score_stream(TWO, [])
    assert scores.down_latency_ms is None
    assert scores.jitter_mm is None


@pytest.mark.parametrize(("name", "ghosts"), [("stroke", 0), ("thumb", 0), ("palm", 1)])
def test_rough_labels(name: str, ghosts: int) -> None:
    """Of what a person was asked to do, taps alone tell positions; a stroke or a thumb is found or missed, and what is
    found under a palm is a ghost."""
    one = truth([(start, start + 20, 30.0, 30.0) for start in (10, 40, 70)])
    acts = tuple(Act(name=act, begin=begin, end=begin + 30) for act, begin in (("tap", 5), (name, 35), ("tap", 65)))
    one = replace(one, meta=one.meta.model_copy(update={"acts": acts}))
    scores = score_stream(one, contact(1, 12, 32, 31, 30) + contact(2, 42, 62, 45, 30) + contact(3, 72, 92, 34, 30))
    assert (scores.touches, scores.missed, scores.ghosts) == (3 - ghosts, 0, ghosts)
    for errors in (scores.error_mm, scores.settled.judged.error_mm):
        assert set(errors[:, 0].round(3).tolist()) == {1.0, 4.0}
