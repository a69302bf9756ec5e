"""Where fingers are going: straight on at the speed of the last frames, each for itself."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.localization.prediction import LONGEST_STEP_MM, Course

FRAME_S = 0.004
SPEED = st.floats(-400, 400)


def moving(course: Course, frames: int, *speeds: tuple[float, float], start: int = 0) -> None:
    """Take in so many frames of fingers that move at constant speeds (mm/s)."""
    for i in range(start, start + frames):
        course.take([(20.0 * k + vx * i * FRAME_S, vy * i * FRAME_S) for k, (vx, vy) in enumerate(speeds)], FRAME_S)


@given(st.lists(st.tuples(SPEED, SPEED), min_size=1, max_size=5))
def test_a_finger_that_moves_evenly_is_foreseen(speeds: list[tuple[float, float]]) -> None:
    course = Course()
    moving(course, 25, *speeds)
    for k, ((x, y), (vx, vy)) in enumerate(zip(course.ahead(FRAME_S), speeds, strict=True)):
        assert x == pytest.approx(20.0 * k + vx * 25 * FRAME_S, abs=1e-3)
        assert y == pytest.approx(vy * 25 * FRAME_S, abs=1e-3)


def test_a_finger_that_has_just_come_is_expected_where_it_is() -> None:
    course = Course()
    course.take([(30.0, 40.0)], FRAME_S)
    assert course.ahead(FRAME_S) == [(30.0, 40.0)]
    assert course.moved_mm == math.inf
    course.take([(30.0, 40.0), (60.0, 40.0)], FRAME_S)
    assert course.ahead(1.0) == [(30.0, 40.0), (60.0, 40.0)]


def test_how_far_one_finger_came_is_told_and_of_several_nothing() -> None:
    course = Course()
    moving(course, 3, (100.0, 0.0))
    assert course.moved_mm == pytest.approx(0.4)
    moving(course, 3, (100.0, 0.0), (0.0, 0.0))
    assert course.moved_mm == math.inf


def test_a_finger_that_lifts_takes_its_speed_along_and_leaves_the_others_theirs() -> None:
    course = Course()
    moving(course, 30, (100.0, 0.0), (-50.0, 20.0), (0.0, 80.0))
    course.drop(1, 3)
    course.places_mm = [course.places_mm[0], course.places_mm[2]]
    (x, _), (_, y) = course.ahead(FRAME_S)
    assert x == pytest.approx(100 * 30 * FRAME_S, abs=1e-3)
    assert y == pytest.approx(80 * 30 * FRAME_S, abs=1e-3)


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 0.1))
def test_no_finger_is_expected_farther_away_than_a_finger_gets(jump_mm: float, elapsed_s: float) -> None:
    course = Course()
    for x in (0.0, jump_mm, jump_mm):
        course.take([(x, 0.0)], elapsed_s)
    assert abs(course.ahead(elapsed_s)[0][0] - jump_mm) <= LONGEST_STEP_MM * (1 + 1e-9)


def test_after_a_turn_nothing_is_foreseen_until_the_next_frames() -> None:
    course = Course()
    moving(course, 10, (100.0, 0.0))
    course.turn()
    course.take([(50.0, 50.0)], FRAME_S)
    assert course.ahead(1.0) == [(50.0, 50.0)]
    course.forget()
    assert course.ahead(1.0) == []
