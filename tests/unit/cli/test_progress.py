"""The time left that a long job shows is the time it takes."""

from __future__ import annotations

import pytest

from touchd.cli.progress import Bars


def left_s(bars: Bars, what: str) -> float | None:
    """The time left that the bar of a part shows; None before its first step."""
    return next((task.time_remaining for task in bars._bar.tasks if task.description == what), None)


@pytest.mark.parametrize(("before_s", "step_s", "steps"), [(40.0, 1.0, 100), (0.0, 0.02, 5000), (5.0, 60.0, 200)])
def test_time_left(before_s: float, step_s: float, steps: int) -> None:
    """From the third step on it is right within a tenth, whatever passed before the first, and at the end it is 0."""
    now_s = 1000.0
    bars = Bars(clock=lambda: now_s)
    assert left_s(bars, "network") is None
    with bars:
        now_s += before_s
        for done in range(1, steps + 1):
            now_s += step_s
            bars.update("network", done, steps)
            if done >= 3:
                assert left_s(bars, "network") == pytest.approx((steps - done) * step_s, rel=0.1, abs=1.0)
        assert left_s(bars, "network") == 0


def test_parts_have_their_own_times() -> None:
    """A part that is done does not change the time left of the next."""
    now_s = 0.0
    bars = Bars(clock=lambda: now_s)
    with bars:
        for what, step_s in (("network", 0.1), ("field", 20.0)):
            for done in range(1, 11):
                now_s += step_s
                bars.update(what, done, 20)
        assert left_s(bars, "network") == pytest.approx(1.0, rel=0.1, abs=1.0)
        assert left_s(bars, "field") == pytest.approx(200.0, rel=0.1)


def test_lines_for_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    """In a file or pipe a job of an hour is seen to go on: a line each ten seconds, and one at each part's end."""
    now_s = 0.0
    with Bars(clock=lambda: now_s) as bars:
        for done in range(1, 51):
            now_s += 1.0
            bars.update("network", done, 50, "validation 3.20 mm")
            if done == 41:
                assert capsys.readouterr().err.splitlines()[-1] == "network: 41 of 50, validation 3.20 mm, 0:00:09 left"
        bars.update("field", 1, 1)
        assert capsys.readouterr().err.splitlines()[0] == "network: 50 of 50, validation 3.20 mm"
    assert capsys.readouterr().err == ""
