"""What strangers cause does not fill the log."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from touchd.sinks.throttle import LONGEST_S, PERIOD_S, Throttle


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=200))
def test_a_flood_is_a_line_a_second_and_a_count(pauses_s: list[float]) -> None:
    """However often a stranger knocks, the log has one line a second, and the lines account for every knock."""
    now_s = 0.0
    throttle = Throttle("subscriber refused", clock=lambda: now_s)
    with capture_logs() as lines:
        for pause_s in pauses_s:
            now_s += pause_s
            throttle.warn(peer="192.0.2.1")
        now_s += LONGEST_S
        throttle.warn(peer="192.0.2.1")
    assert len(lines) <= 1 + now_s / PERIOD_S
    assert len(lines) + sum(line.get("unlogged", 0) for line in lines) == len(pauses_s) + 1


def test_what_goes_on_is_a_line_a_minute() -> None:
    """A health check that knocks every five seconds makes a line a minute; a stranger after a silence, one at once."""
    now_s = 0.0
    throttle = Throttle("subscriber refused", clock=lambda: now_s)
    with capture_logs() as lines:
        for _ in range(24 * 3600 // 5):
            now_s += 5
            throttle.warn(peer="192.0.2.1")
        assert 24 * 60 <= len(lines) <= 24 * 60 + 10
        assert lines[-1]["unlogged"] == 11
        now_s += LONGEST_S
        assert throttle.warn(peer="192.0.2.2")
        now_s += PERIOD_S
        assert throttle.warn(peer="192.0.2.2")
