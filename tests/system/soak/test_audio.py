"""An audio interface at full speed: each frame is what its number says, and what is missing is counted."""

from __future__ import annotations

from tests.system.soak.audio import run


def test_no_frame_is_lost_uncounted() -> None:
    """Through xruns and an unplugged card: as `python -m tests.system.soak.audio`, shorter."""
    result = run(4400, xrun_every=701, unplug_every=2003)
    assert (result.xruns, result.unplugs) >= (5, 1)
    assert result.out_of_order == 0
    assert result.unaccounted == 0
    assert result.withheld > 0
    assert result.first_frame_s < 1.0
