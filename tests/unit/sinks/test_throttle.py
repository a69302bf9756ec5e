"""What strangers cause does not fill the log."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from touchd.sinks.throttle import PERIOD_S, Throttle


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=200))
def test_a_flood_is_a_line_a_second_and_a_count(pauses_s: list[float]) -> None:
    """However often a stranger knocks, the log has one line a second, and the lines account for every knock."""
    now_s = 0.0
    throttle = Throttle("subscriber refused", clock=lambda: now_s)
    with capture_logs() as lines:
        for pause_s in pauses_s:
            now_s += pause_s
            throttle.warn(peer="192.0.2.1")
        now_s += PERIOD_S
        throttle.warn(peer="192.0.2.1")
    assert len(lines) <= 1 + now_s / PERIOD_S
    assert len(lines) + sum(line.get("unlogged", 0) for line in lines) == len(pauses_s) + 1
