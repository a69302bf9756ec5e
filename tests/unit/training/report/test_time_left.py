"""The time left is one for the whole training, and right as soon as anything can be known."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.training.report.time_left import EPOCH_S, FIELD_S, TOUCHES, TimeLeft, say


class Clock:
    """A clock that is set."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@given(st.floats(0.1, 50), st.integers(20, 400), st.integers(10, 100))
def test_on_any_machine_the_whole_is_foretold_while_the_field_is_learned(
    slowness: float, epochs: int, jobs: int
) -> None:
    """As long as field and epochs cost what they cost beside each other."""
    clock = Clock()
    left = TimeLeft(TOUCHES, epochs, clock)
    total_s = slowness * (FIELD_S + epochs * EPOCH_S)
    for job in range(1, jobs + 1):
        clock.now_s = slowness * FIELD_S * job / jobs
        said = left.after("field", job, jobs)
        if job < 0.1 * jobs:
            assert said is None
        else:
            assert said == pytest.approx(total_s - clock.now_s)
    start_s = clock.now_s
    for epoch in range(1, epochs + 1):
        clock.now_s = start_s + slowness * EPOCH_S * epoch
        said = left.after("network", epoch, epochs)
        if epoch > 1:
            assert said == pytest.approx(total_s - clock.now_s, abs=1e-6 * total_s)


def test_without_a_field_the_epochs_alone_count_from_the_first_on() -> None:
    clock = Clock()
    left = TimeLeft(1000, 10, clock)
    clock.now_s = 2.0
    assert left.after("network", 1, 10) == pytest.approx(18.0)


def test_epochs_are_timed_whatever_was_expected_of_them() -> None:
    clock = Clock()
    left = TimeLeft(TOUCHES, 100, clock)
    clock.now_s = 10.0
    left.after("field", 1, 1)
    for epoch in range(1, 4):
        clock.now_s = 10.0 + 7.0 * epoch
        said = left.after("network", epoch, 100)
    assert said == pytest.approx(7.0 * 97)


@pytest.mark.parametrize(
    ("left_s", "words"), [(None, ""), (0.2, "done"), (42.4, "42 s left"), (301.0, "5 min left"), (100.0, "2 min left")]
)
def test_a_time_is_said_as_one_would_say_it(left_s: float | None, words: str) -> None:
    assert say(left_s) == words
