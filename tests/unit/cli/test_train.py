"""What `touchd train` says while it works, by a clock that the test moves."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from touchd.cli.progress import TimeLeft


def estimates(durations_s: Sequence[float]) -> list[tuple[float, float]]:
    """Return each estimate of the time left and the true one, s, for steps that take so long."""
    now_s = 0.0
    left = TimeLeft(lambda: now_s)
    found = []
    for done, duration_s in enumerate(durations_s, start=1):
        now_s += duration_s
        text = left.update(done, len(durations_s))
        if text:
            hours, minutes, seconds = map(int, text.removesuffix(" left").split(":"))
            found.append((3600.0 * hours + 60 * minutes + seconds, sum(durations_s[done:])))
    return found


def test_even_steps() -> None:
    """The time left of even steps is right to a second."""
    found = estimates([12.5] * 800)
    assert len(found) > 700
    assert all(estimate == pytest.approx(true, abs=1) for estimate, true in found)


@pytest.mark.parametrize("slow", [0, 1, 5, 300])
def test_one_slow_step(slow: int) -> None:
    """One step of 40 s among 376 short ones does not make hours of a minute and a half."""
    durations_s = [0.15] * 377
    durations_s[slow] = 40.0
    found = estimates(durations_s)
    assert found
    assert max(estimate for estimate, _ in found) < 98


def test_uneven_steps() -> None:
    """Steps that come in bursts and grow longer, as those of a field do, never seem to take longer than they will."""
    durations_s = [0.3] * 9 + [8.0] + [0.05] * 40 + [0.1 + 0.015 * i for i in range(110)]
    found = estimates(durations_s)
    assert len(found) > 140
    assert all(0 < estimate < 1.5 * true + 1 for estimate, true in found[:-1])


def test_growing_steps() -> None:
    """Half-way through steps that grow to 17 times the first, two fifths of the time left show; it was a fifth."""
    found = estimates([0.1 * 1.0095**i for i in range(300)])
    estimate, true = found[len(found) // 2]
    assert estimate > 0.4 * true


def test_nothing_to_know() -> None:
    """Nothing is said of the first steps, and nothing at the end."""
    assert estimates([1.0]) == estimates([1.0, 1.0]) == []
    assert len(estimates([1.0] * 100)) == 93


def test_left_by_leaps() -> None:
    """A job that tells of many steps at once, or of the same one twice, has its time left, too."""
    now_s = 0.0
    left = TimeLeft(lambda: now_s)
    said = []
    for done in (0, 10, 10, 30, 60):
        said.append(left.update(done, 100))
        now_s += 10.0
    assert said[-1] == "0:00:24 left", "50 steps took 30 s, the slowest left out"
