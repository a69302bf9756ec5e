"""Each finger is expected where the speed of its last frames takes it."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.localization.following import LONGEST_S, LONGEST_STEP_MM, Prediction

FRAME_NS = 4_000_000
FRAME_S = FRAME_NS * 1e-9
SPEED = st.floats(-400, 400)


def moving(frames: int, *speeds: tuple[float, float], prediction: Prediction | None = None) -> Prediction:
    """A prediction of fingers that move at constant speeds (mm/s), 20 mm apart at first."""
    prediction = prediction or Prediction()
    for i in range(frames):
        positions = [(20.0 * k + vx * i * FRAME_S, vy * i * FRAME_S) for k, (vx, vy) in enumerate(speeds)]
        prediction.update(positions, prediction.t_ns + FRAME_NS)
    return prediction


@given(st.lists(st.tuples(SPEED, SPEED), min_size=1, max_size=5))
def test_constant_speed(speeds: list[tuple[float, float]]) -> None:
    """A finger that moves evenly is predicted, one frame ahead and several, up to 0.1 s."""
    prediction = moving(25, *speeds)
    for ahead_s in (FRAME_S, 5 * FRAME_S, 1e3):
        positions = prediction.ahead(prediction.t_ns + round(ahead_s * 1e9))
        t_s = 24 * FRAME_S + min(ahead_s, LONGEST_S)
        for k, ((x, y), (vx, vy)) in enumerate(zip(positions, speeds, strict=True)):
            assert (x, y) == pytest.approx((20.0 * k + vx * t_s, vy * t_s), abs=1e-3)


def test_new_finger() -> None:
    """A finger that has just come is expected where it is."""
    prediction = Prediction()
    prediction.update([(30.0, 40.0)], FRAME_NS)
    assert prediction.ahead(2 * FRAME_NS) == [(30.0, 40.0)]
    assert prediction.moved_mm == math.inf
    prediction.update([(30.0, 40.0), (60.0, 40.0)], 2 * FRAME_NS)
    assert prediction.ahead(10**9) == [(30.0, 40.0), (60.0, 40.0)]


def test_movement() -> None:
    """`moved_mm` is the movement of one finger, and infinite for several."""
    assert moving(3, (100.0, 0.0)).moved_mm == pytest.approx(0.4)
    assert moving(3, (100.0, 0.0), (0.0, 0.0)).moved_mm == math.inf


def test_lifted_finger() -> None:
    """A finger that lifts leaves the others their speeds."""
    prediction = moving(30, (100.0, 0.0), (-50.0, 20.0), (0.0, 80.0))
    prediction.remove(1)
    (x, _), (_, y) = prediction.ahead(prediction.t_ns + FRAME_NS)
    assert x == pytest.approx(100 * 30 * FRAME_S, abs=1e-3)
    assert y == pytest.approx(80 * 30 * FRAME_S, abs=1e-3)


@given(st.floats(-1e6, 1e6), st.integers(1_000, 100_000_000))
def test_longest_step(jump_mm: float, elapsed_ns: int) -> None:
    """No finger is expected farther away than a finger gets in a frame."""
    prediction = Prediction()
    for i, x in enumerate((0.0, jump_mm, jump_mm), 1):
        prediction.update([(x, 0.0)], i * elapsed_ns)
    assert abs(prediction.ahead(4 * elapsed_ns)[0][0] - jump_mm) <= LONGEST_STEP_MM * (1 + 1e-9)


def test_rest() -> None:
    """A finger that rested is expected where it was, and its next speed is over the time since the last frame."""
    prediction = moving(10, (100.0, 0.0))
    ((x_mm, _),) = prediction.positions_mm
    for _ in range(100):
        prediction.rest(prediction.t_ns + FRAME_NS)
    assert prediction.ahead(prediction.t_ns + FRAME_NS) == [(x_mm, 0.0)]
    prediction.update([(x_mm + 0.4, 0.0)], prediction.t_ns + FRAME_NS)
    assert prediction.ahead(prediction.t_ns + FRAME_NS)[0][0] == pytest.approx(x_mm + 0.4 + 0.2)


def test_other_fingers() -> None:
    """After `forget_velocities` nothing is predicted until the next frames, after `reset` no finger is left."""
    prediction = moving(10, (100.0, 0.0))
    prediction.forget_velocities()
    prediction.update([(50.0, 50.0)], prediction.t_ns + FRAME_NS)
    assert prediction.ahead(prediction.t_ns + 10**9) == [(50.0, 50.0)]
    prediction.reset()
    assert prediction.ahead(prediction.t_ns + 10**9) == []


@pytest.mark.parametrize("step_ns", [0, -1, -(10**12)])
def test_clock_steps_back(step_ns: int) -> None:
    """A clock that stands or steps back predicts no movement."""
    prediction = moving(10, (100.0, 0.0))
    assert prediction.ahead(prediction.t_ns + step_ns) == prediction.positions_mm
    prediction.update([(50.0, 50.0)], prediction.t_ns + step_ns)
    assert prediction.ahead(prediction.t_ns + FRAME_NS) == [(50.0, 50.0)]
