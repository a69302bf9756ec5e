"""Numbers of frames grow by what the device sent, and each frame that is missing counts once."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from touchd.sources.intake import Intake

steps = st.tuples(st.integers(0, 5), st.integers(0, 5), st.booleans())


@given(st.integers(0, 2**32), st.lists(steps, max_size=20))
def test_each_missing_frame_counts_once(first: int, gaps: list[tuple[int, int, bool]]) -> None:
    """Between two frames of a stream each number is lost or corrupt; over a restart nothing is lost."""
    intake = Intake(125)
    assert intake.number(first, 0) == (first, 0)
    number, sequence, corrupt = first, first, 0
    for lost, bad, restarts in gaps:
        corrupt += bad
        sequence += 1 + lost + bad
        if restarts:
            intake.restart()
            sequence, number, lost = sequence % 1000, number + 1, 0
        else:
            number += 1 + lost + bad
        assert intake.number(sequence, corrupt) == (number, lost)


def test_a_number_that_is_not_new_is_returned_as_it_is() -> None:
    """The pipeline tells a repetition from a device that restarts."""
    intake = Intake(125)
    assert [intake.number(n, 0) for n in (5, 6, 6, 2, 7)] == [(5, 0), (6, 0), (6, 0), (2, 0), (7, 4)]


def test_no_number_is_negative() -> None:
    """A device that counts from a high number after it was plugged in, and then restarts, has its frames counted on."""
    intake = Intake(125)
    intake.number(100, 0)
    intake.restart()
    assert [intake.number(n, 0)[0] for n in (1_000_000, 1_000_001, 0, 1)] == [101, 102, 0, 1]
